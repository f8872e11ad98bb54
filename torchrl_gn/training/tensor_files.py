"""Safetensors files: tensors by name, written atomically, with a checksum."""

from __future__ import annotations

import hashlib
import os
import re
import struct
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchrl_gn.atomic import atomic_path

# Errors from reading a file that is damaged, or has dtypes or metadata that safetensors do not allow.
DAMAGE = (SafetensorError, OSError, struct.error, ValueError, TypeError, LookupError, AttributeError, RuntimeError)


def write_tensors(path: str | os.PathLike, tensors: Mapping[str, Tensor], **metadata: str) -> None:
    """Write tensors, with short texts and a checksum in the header.

    Raises:
        OSError: if there is no space; the old file is kept.
    """
    # Copies: safetensors refuses tensors that share memory.
    layout = torch.contiguous_format
    copies = {name: value.detach().cpu().clone(memory_format=layout) for name, value in tensors.items()}
    texts = {**metadata, "sha256": digest_of(copies)}
    with atomic_path(path) as temporary:
        try:
            save_file(copies, temporary, metadata=texts)
        except SafetensorError as error:
            # This includes a full disk; its error number is only in the text.
            number = re.search(r"\(os error (\d+)\)", str(error))
            raise OSError(*([int(number[1])] if number else []), str(error)) from error


def read_tensors(path: str | os.PathLike) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read tensors and metadata of a safetensors file; raise an error of :data:`DAMAGE` if it cannot be read."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}


def load_tensors(path: str | os.PathLike) -> dict[str, Tensor]:
    """Read the tensors of a safetensors file, and verify its checksum if :func:`write_tensors` wrote it.

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


def digest_of(tensors: Mapping[str, Tensor], text: str = "") -> str:
    """Compute the checksum of a text and of CPU tensors: names, dtypes, shapes and values."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        digest.update(f"{name}{value.dtype}{list(value.shape)}".encode())
        digest.update(value.flatten().view(torch.uint8).numpy().tobytes() if value.numel() else b"")
    return digest.hexdigest()
