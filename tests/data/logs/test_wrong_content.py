"""Files whose content contradicts their suffix are refused by name, as robot logs and as pose logs."""

from __future__ import annotations

import gzip
import io
import pickle
import zipfile
from collections.abc import Callable

import numpy as np
import pytest

from torchrl_gn.data import DatasetError, load_pose_log, load_robot_log
from torchrl_gn.data.logs.robot_log_formats import READERS

NAMES = ("angle", "velocity", "command", "position", "quaternion")


def written(write: Callable[[io.BytesIO], object]) -> bytes:
    write(out := io.BytesIO())
    return out.getvalue()


def zipped(name: str) -> bytes:
    def write(out: io.BytesIO) -> None:
        with zipfile.ZipFile(out, "w") as file:
            for each in NAMES:
                file.writestr(name.format(each), "hello")

    return written(write)


def npz(values: np.ndarray) -> bytes:
    return written(lambda out: np.savez(out, **dict.fromkeys(NAMES, values)))


CONTENTS = {
    "nothing": b"",
    "zeros": bytes(100),
    "text": b"hello\nworld",
    "header alone": b"angle0,velocity0,command0\n",
    "JSON": b"{}",
    "no UTF-8": b"\xff\xfe,a\n1,2",
    "picture": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "gzip": gzip.compress(b"angle0\n1"),
    "HDF5 that is cut": b"\x89HDF\r\n\x1a\n",
    "Parquet that is cut": b"PAR1",
    "pickle": pickle.dumps({"angle": 1}),
    "array": written(lambda out: np.save(out, np.zeros((5, 2)))),
    "pickled array": written(lambda out: np.save(out, np.array([{}]), allow_pickle=True)),
    "zip of texts": zipped("{}.txt"),
    "zip of texts called arrays": zipped("{}.npy"),
    "pickled arrays": npz(np.array([{}])),
    "arrays of text": npz(np.array(["a", "b"])),
    "no rows": npz(np.zeros((0, 2))),
    "numbers": npz(np.array(1.0)),
}


@pytest.mark.filterwarnings("ignore:loadtxt")
@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS)
@pytest.mark.parametrize("suffix", READERS)
def test_other_content_is_refused_by_name(tmp_path, suffix, content):
    pytest.importorskip({".parquet": "pyarrow", ".hdf5": "h5py", ".h5": "h5py"}.get(suffix, "numpy"))
    (path := tmp_path / f"log{suffix}").write_bytes(content)
    with pytest.raises(DatasetError, match=r"log\."):
        load_robot_log(path, timestep=0.1)
    with pytest.raises(DatasetError, match=r"log\."):
        load_pose_log(path, timestep=0.1)
