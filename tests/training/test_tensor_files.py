"""Tensors in files: written whole, and read only whole."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from torchrl_gn.training.tensor_files import load_tensors, write_tensors


@pytest.fixture
def kept(tmp_path):
    path = tmp_path / "folder" / "played.safetensors"
    whole = torch.arange(24.0).reshape(2, 3, 4)
    write_tensors(path, {"state": whole.transpose(0, 1), "same": whole, "none": whole[:0]})
    return path, whole


def test_tensors_come_back(kept):
    path, whole = kept
    found = load_tensors(path)
    assert torch.equal(found["state"], whole.transpose(0, 1)) and torch.equal(found["same"], whole)
    assert found["none"].shape == (0, 3, 4) and [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_missing_file_is_named_and_one_without_checksum_is_read(tmp_path):
    with pytest.raises(ValueError, match="There is no file .*gone"):
        load_tensors(tmp_path / "gone.safetensors")
    save_file({"action": torch.ones(2)}, tmp_path / "own.safetensors")
    assert torch.equal(load_tensors(tmp_path / "own.safetensors")["action"], torch.ones(2))
