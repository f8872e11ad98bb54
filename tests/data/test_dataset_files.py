"""Files of data sets that are malicious or damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchrl_gn.atomic import read_json, write_json
from torchrl_gn.data import DatasetError, create_dataset, load_dataset
from torchrl_gn.scenes import Scene

from .conftest import contents, equal
from .test_dataset import SIZES

pytestmark = pytest.mark.usefixtures("small_chunks")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_damage_anywhere_is_refused_by_name_or_harmless(seed: int, tmp_path: Path, pendulum: Scene) -> None:
    """A byte that is another one, and files that end early."""
    made = create_dataset(tmp_path / "d", pendulum, **SIZES)
    rng, files = np.random.default_rng(seed), [path for path in (tmp_path / "d").rglob("*") if path.is_file()]
    for file in files:
        whole = file.read_bytes()
        cut = whole[: int(rng.integers(len(whole)))]
        for damaged in (cut, *(_other_byte(whole, rng) for _ in range(20))):
            file.write_bytes(damaged)
            before = contents(tmp_path)
            try:
                found = load_dataset(tmp_path / "d", pendulum)
            except DatasetError as error:
                assert str(tmp_path / "d") in str(error)
            else:
                assert all(equal(getattr(found, split), getattr(made, split)) for split in ("train", "test"))
            assert contents(tmp_path) == before
        file.write_bytes(whole)


def _other_byte(content: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(content)))
    return content[:at] + bytes([content[at] ^ int(rng.integers(1, 256))]) + content[at + 1 :]


@pytest.mark.parametrize(
    "name", ["manifest.json", "train/state.memmap", "train/meta.json", "train", "manifest.json.tmp"]
)
def test_nothing_is_written_through_links(name: str, tmp_path: Path, pendulum: Scene) -> None:
    """An unfinished data set of an attacker may hold a link."""
    theirs = tmp_path / "theirs"
    create_dataset(tmp_path / "d", pendulum, **SIZES)
    manifest = read_json(tmp_path / "d" / "manifest.json")
    manifest["chunks"] = {split: [] for split in manifest["chunks"]}
    write_json(tmp_path / "d" / "manifest.json", manifest)
    link = tmp_path / "d" / name
    if link.exists():
        link.rename(theirs)
    else:
        theirs.write_text("theirs")
    link.symlink_to(theirs)
    before = {path: content for path, content in contents(tmp_path).items() if path.startswith("theirs")}
    if name == "manifest.json.tmp":
        create_dataset(tmp_path / "d", pendulum, **SIZES)
    else:
        with pytest.raises(DatasetError, match=f"{link}: a link, to which nothing is written"):
            create_dataset(tmp_path / "d", pendulum, **SIZES)
    after = {path: content for path, content in contents(tmp_path).items() if path.startswith("theirs")}
    assert before and before == after
