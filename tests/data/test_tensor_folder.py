"""Folders of memory-mapped TensorDicts: tensors are read, nothing runs, nothing is written."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
import torch
from tensordict import LazyStackedTensorDict, NonTensorData, TensorDict

from torchrl_gn.data import open_tensors, save_tensors

from ..faults.bench import can_mount, disk

GENERATOR = torch.Generator().manual_seed(0)
DTYPES = [
    torch.float64,
    torch.float32,
    torch.float16,
    torch.bfloat16,
    torch.int64,
    torch.int32,
    torch.uint8,
    torch.bool,
]


class Planted:
    """Code that a pickle runs when it is read."""

    def __init__(self, file: Path):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder of two tensors, one in a folder below."""
    tensors = {"state": torch.rand(4, 3, generator=GENERATOR), "inner": {"action": torch.arange(8.0).view(4, 2)}}
    TensorDict(tensors, [4]).memmap(str(tmp_path / "d"))
    return tmp_path / "d"


def test_what_is_saved_is_opened_also_over_what_was_there(folder):
    for factor in (1, 2):
        numbers = factor * torch.rand(7, 2, generator=GENERATOR)
        save_tensors(folder, TensorDict({"state": numbers, "inner": {"action": numbers[:, 0].double()}}, [7]))
        found = open_tensors(folder)
        assert found.batch_size == (7,) and torch.equal(found["state"], numbers)
        assert torch.equal(found["inner", "action"], numbers[:, 0].double())


def test_what_was_not_saved_to_its_end_is_refused(folder, files_end_at):
    data = TensorDict({"state": torch.rand(7, 2, generator=GENERATOR)}, [7])
    save_tensors(folder, data)
    with files_end_at(150), pytest.raises(OSError):
        save_tensors(folder, torch.cat([data] * 50))
    with pytest.raises(ValueError, match=r"d: writing was interrupted; write it again\."):
        open_tensors(folder)


@pytest.mark.parametrize(
    ("sums", "message"),
    [
        ([1], "'' is not a name of a file"),
        ({"../state.memmap": 1}, r"'\.\./state\.memmap' is not a name of a file"),
        ({"other.memmap": 1}, r"other\.memmap: no such file"),
        ({"state.memmap": "1"}, r"state\.memmap: its checksum differs"),
    ],
)
def test_forged_checksums_are_refused(folder, sums, message):
    (folder / "checksums.json").write_text(json.dumps(sums))
    with pytest.raises(ValueError, match=message):
        open_tensors(folder)


def test_without_room_nothing_ends_but_the_call(tmp_path, files_end_at):
    large = TensorDict({"state": torch.ones(5000, 3)}, [5000])
    with (
        files_end_at(20_000),
        pytest.raises(OSError, match=r"d cannot be written: .*\. Make room and run the same again"),
    ):
        save_tensors(tmp_path / "d", large)
    save_tensors(tmp_path / "d", large)
    assert torch.equal(open_tensors(tmp_path / "d")["state"], large["state"])


@pytest.mark.parametrize("share", [0.1, 0.4, 0.8])
def test_on_a_full_disk_nothing_ends_but_the_call(tmp_path, share):
    if not can_mount(tmp_path):
        pytest.skip("needs leave to mount a disk in memory")
    data = TensorDict({name: torch.ones(5000, 3) for name in "abc"}, [5000])
    with disk(tmp_path / "small", int(share * 3 * 60_000)), pytest.raises(OSError) as caught:
        save_tensors(tmp_path / "small" / "d", data)
    assert caught.value.errno == errno.ENOSPC


def contents(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def edit(file: Path, **changes) -> Path:
    """Change entries of a layout; None takes one out."""
    layout = json.loads(file.read_text()) | changes
    file.write_text(json.dumps({name: entry for name, entry in layout.items() if entry is not None}))
    return file


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_tensors_are_as_they_were_written(tmp_path, dtype):
    numbers = (50 * torch.rand(5, 2, 3, generator=GENERATOR, dtype=torch.float64)).to(dtype)
    of = {"a": numbers, "b": {"c-1": numbers[:, 0], "d": {"e.f": numbers[..., 0].clone()}}, "none": numbers[:, :0]}
    written = TensorDict(of, [5])
    written.memmap(str(tmp_path))
    found = open_tensors(tmp_path)
    assert found.batch_size == written.batch_size
    assert set(found.keys(True, True)) == set(written.keys(True, True))
    for key in written.keys(True, True):
        assert found[key].dtype == dtype and torch.equal(found[key], written[key])


def test_files_stay_as_they_are(folder):
    before = contents(folder)
    found = open_tensors(folder)
    found["state"].zero_()
    found["inner", "action"].fill_(torch.nan)
    assert contents(folder) == before and open_tensors(folder)["state"].any()


def test_files_that_cannot_be_written_are_read(folder):
    for file in contents(folder):
        file.chmod(0o444)
    assert open_tensors(folder)["state"].shape == (4, 3)


@pytest.mark.parametrize("place", ["note", ("inner", "note")])
def test_pickled_code_does_not_run(folder, tmp_path, place):
    data = TensorDict.load_memmap(folder).clone()
    data.set(place, NonTensorData(Planted(tmp_path / "ran"), batch_size=[4]))
    data.memmap(str(tmp_path / "e"))
    assert list((tmp_path / "e").rglob("*.pickle"))
    with pytest.raises(ValueError, match=r"meta.json: 'note' is of type 'NonTensorData', and only tensors are read"):
        open_tensors(tmp_path / "e")
    # Nor if it says to be a TensorDict.
    at = (tmp_path / "e").joinpath(*([place] if isinstance(place, str) else place))
    edit(at.parent / "meta.json", note={"type": "TensorDict"})
    with pytest.raises(ValueError, match=r"note/meta.json: describes <class 'tensordict.tensorclass.NonTensorData'>"):
        open_tensors(tmp_path / "e")
    assert not (tmp_path / "ran").exists()


def test_what_is_not_one_tensordict_is_refused(folder, tmp_path):
    LazyStackedTensorDict(*TensorDict.load_memmap(folder).clone().unbind(0)).memmap(str(tmp_path / "lazy"))
    with pytest.raises(ValueError, match="describes .*LazyStackedTensorDict"):
        open_tensors(tmp_path / "lazy")
    for nothing in (tmp_path, tmp_path / "nowhere", folder / "state.memmap"):
        with pytest.raises(ValueError, match="no such file, so the folder holds no tensors"):
            open_tensors(nothing)


@pytest.mark.parametrize("size", [0, 5, 47, 49, 4096])
def test_a_file_of_another_length_is_refused_and_kept(folder, size):
    os.truncate(folder / "state.memmap", size)
    before = contents(folder)
    with pytest.raises(ValueError, match=f"state.memmap: {size} bytes, should be 48: truncated or changed"):
        open_tensors(folder)
    assert contents(folder) == before


@pytest.mark.parametrize("made", [lambda _: None, os.mkdir, os.mkfifo], ids=["nothing", "folder", "pipe"])
def test_a_missing_file_is_refused(folder, made):
    (folder / "state.memmap").unlink()
    made(folder / "state.memmap")
    with pytest.raises(ValueError, match="state.memmap: missing"):
        open_tensors(folder)


PLAIN = {"shape": [4, 3], "dtype": "torch.float32"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": PLAIN | {"shape": [4, 2**40, 2**40]}}, "'state' is not a plain tensor"),
        ({"state": PLAIN | {"shape": [4, 2**40]}}, "48 bytes, should be 17592186044416"),
        ({"state": PLAIN | {"shape": [4, 0, 2**62]}}, "'state' is not a plain tensor"),
        ({"state": PLAIN | {"shape": [4, -3]}}, "'state' is not a plain tensor"),
        ({"state": PLAIN | {"shape": [4, True]}}, "'state' is not a plain tensor"),
        ({"state": PLAIN | {"shape": [4, 3.0]}}, "'state' is not a plain tensor"),
        ({"state": PLAIN | {"shape": [3, 4]}}, r"'state' is not a plain tensor of real numbers \[4, '...'\]"),
        ({"state": PLAIN | {"shape": [4, *(1 for _ in range(100))]}}, "'state' is not a plain tensor"),
        ({"state": {"shape": [4, 3]}}, "it has dtype None"),
        ({"state": PLAIN | {"dtype": "torch.complex64"}}, "it has dtype 'torch.complex64'"),
        ({"state": PLAIN | {"dtype": ["torch.float32"]}}, "'state' is not a plain tensor"),
        ({"state": PLAIN | {"is_nested": True}}, "'state' is not a plain tensor"),
        ({"state": PLAIN | {"dtype": "torch.bool", "shape": [4, 12]}}, "other numbers than false and true"),
        ({"../d/state": PLAIN}, "'../d/state' is not a name of a tensor"),
        ({"..": {"type": "TensorDict"}}, "'..' is not a name of a tensor"),
        ({"/etc": {"type": "TensorDict"}}, "'/etc' is not a name of a tensor"),
        ({"shape": None}, "None is not a batch size"),
        ({"shape": 4}, "4 is not a batch size"),
        ({"_type": "os.system"}, "describes os.system"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(folder, changes, message):
    edit(folder / "meta.json", **changes)
    with pytest.raises(ValueError, match=message):
        open_tensors(folder)


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "[" * 100_000, "\xff"])
def test_a_damaged_layout_is_refused(folder, text):
    (folder / "inner" / "meta.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match="inner/meta.json"):
        open_tensors(folder)


def test_a_layout_of_megabytes_is_refused(folder):
    file = folder / "meta.json"
    file.write_text(file.read_text() + " " * 2**20)
    with pytest.raises(ValueError, match="bytes are too many for a description of tensors"):
        open_tensors(folder)


def test_folders_without_end_are_refused(folder):
    edit(folder / "meta.json", again={"type": "TensorDict"})
    (folder / "again").symlink_to(folder)
    with pytest.raises(ValueError, match="again: a link, not a folder"):
        open_tensors(folder)


def test_too_many_folders_in_each_other_are_refused(folder):
    for _ in range(20):
        edit(folder / "meta.json", again={"type": "TensorDict"})
        folder = folder / "again"
        TensorDict({}, [4]).memmap(str(folder))
    assert open_tensors(folder.parents[19]).shape == (4,)
    edit(folder / "meta.json", again={"type": "TensorDict"})
    TensorDict({}, [4]).memmap(str(folder / "again"))
    with pytest.raises(ValueError, match="more than 20 nested folders"):
        open_tensors(folder.parents[19])


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("a/b", torch.ones(2), "'a/b' cannot be the name"),
        ("a b", torch.ones(2), "'a b' cannot be the name"),
        ("\u00fc", torch.ones(2), "cannot be the name"),
        ("shape", torch.ones(2), "'shape' cannot be the name"),
        (("inner", "_type"), torch.ones(2), "cannot be the name"),
        ("wave", torch.ones(2, dtype=torch.complex64), "'wave' is not a plain tensor of real numbers"),
        ("sparse", torch.eye(2).to_sparse(), "'sparse' is not a plain tensor of real numbers"),
        ("note", "text", "'note' is not a plain tensor of real numbers"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(tmp_path, key, value, message):
    save_tensors(tmp_path / "d", TensorDict({"state": torch.arange(2)}, [2]))
    with pytest.raises(ValueError, match=message):
        save_tensors(tmp_path / "d", TensorDict({"state": torch.zeros(2)}, [2]).set(key, value))
    assert open_tensors(tmp_path / "d")["state"].tolist() == [0, 1]


def test_numbers_of_every_kind_are_read_as_they_were_written(tmp_path):
    tiny = torch.tensor([5e-324, -0.0, float("nan"), float("inf")], dtype=torch.float64)
    data = {
        "transposed": torch.arange(12.0).view(3, 4).t(),
        "expanded": torch.ones(4, 1).expand(4, 5),
        "half": torch.tensor([6e-8, -0.0, 65504.0, 1.0]).half(),
        "bfloat": torch.tensor([1e-40, -0.0, 3e38, 1.0]).bfloat16(),
        "tiny": tiny,
        "negated": torch._neg_view(tiny),
        "flags": torch.tensor([True, False, True, True]),
        "none": torch.zeros(4, 0),
    }
    save_tensors(tmp_path / "d", TensorDict(data, [4]))
    found = open_tensors(tmp_path / "d")
    for name, value in data.items():
        value = value.resolve_neg().contiguous()
        assert found[name].dtype == value.dtype and found[name].shape == value.shape
        if value.numel():
            assert found[name].contiguous().view(torch.uint8).tolist() == value.view(torch.uint8).tolist(), name
