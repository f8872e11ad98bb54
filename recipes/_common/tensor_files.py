"""Read files of episodes and trajectories, and verify their checksums."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from torchrl_gn.training.tensor_files import DAMAGE, digest_of, read_tensors


def load_tensors(path: str | Path) -> dict[str, Tensor]:
    """Read a safetensors file, and verify its checksum if :func:`write_tensors` wrote it.

    Raises:
        ValueError: if the file is missing or damaged.
    """
    if not Path(path).is_file():
        raise ValueError(f"There is no file {path}.")
    try:
        tensors, metadata = read_tensors(path)
    except DAMAGE as error:
        raise ValueError(f"{path} is damaged ({error}); delete it, or name another.") from error
    if "sha256" in metadata and digest_of(tensors) != metadata["sha256"]:
        raise ValueError(f"{path} is damaged (checksum differs); delete it, or name another.")
    return tensors
