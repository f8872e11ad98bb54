"""Safetensors files: tensors by name, written atomically, with a checksum."""

from __future__ import annotations

import hashlib
import os
import re
import struct
from collections.abc import Mapping

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchrl_gn.atomic import atomic_path

# What reading a file raises that is damaged, or has dtypes or metadata of no safetensors file.
DAMAGE = (SafetensorError, OSError, struct.error, ValueError, TypeError, LookupError, AttributeError, RuntimeError)


def write_tensors(path: str | os.PathLike, tensors: Mapping[str, Tensor], **metadata: str) -> None:
    """Write tensors, with short texts and a checksum in the header; OSError, and the old file, if there is no space."""
    # Copies: safetensors refuses what shares memory.
    apart = {name: value.detach().cpu().clone(memory_format=torch.contiguous_format) for name, value in tensors.items()}
    texts = {**metadata, "sha256": digest_of(apart)}
    with atomic_path(path) as temporary:
        try:
            save_file(apart, temporary, metadata=texts)
        except SafetensorError as error:
            # Also of a full disk, whose number stands in the text alone.
            number = re.search(r"\(os error (\d+)\)", str(error))
            raise OSError(*([int(number[1])] if number else []), str(error)) from error


def read_tensors(path: str | os.PathLike) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file; raises what :data:`DAMAGE` lists if it cannot be read."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}


def digest_of(tensors: Mapping[str, Tensor], text: str = "") -> str:
    """Checksum of tensors on the CPU, by name, dtype and shape, and of a text."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        digest.update(f"{name}{value.dtype}{list(value.shape)}".encode())
        digest.update(value.flatten().view(torch.uint8).numpy().tobytes() if value.numel() else b"")
    return digest.hexdigest()
