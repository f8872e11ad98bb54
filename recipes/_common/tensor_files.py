"""Files of episodes and trajectories: tensors by name, written atomically, with a checksum that reading checks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from torchrl_gn.atomic import atomic_path
from torchrl_gn.training.checkpoint import DAMAGE, digest_of, read_tensors


def save_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors to a safetensors file."""
    # Copies: safetensors refuses what shares memory.
    apart = {name: value.detach().cpu().clone(memory_format=torch.contiguous_format) for name, value in tensors.items()}
    with atomic_path(path) as temporary:
        save_file(apart, temporary, metadata={"sha256": digest_of(apart)})


def load_tensors(path: str | Path) -> dict[str, Tensor]:
    """Read a safetensors file; of others than :func:`save_tensors` wrote, no checksum is checked.

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
