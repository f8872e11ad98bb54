"""Files of episodes and trajectories: tensors by name, written atomically, with a checksum that reading checks."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchrl_gn.atomic import atomic_path
from torchrl_gn.training.checkpoint import digest_of


def save_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors to a safetensors file."""
    # Copies: safetensors refuses what shares memory.
    apart = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
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
        with safe_open(path, framework="pt") as file:
            metadata, tensors = file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, struct.error) as error:
        raise ValueError(f"{path} is damaged ({error}); delete it, or name another.") from error
    if metadata.get("sha256", written := digest_of(tensors)) != written:
        raise ValueError(f"{path} is damaged (checksum differs); delete it, or name another.")
    return tensors
