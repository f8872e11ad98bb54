"""Whether tensors are as they were."""

from __future__ import annotations

import operator
from collections.abc import Sequence

from torch import Tensor


class Watched:
    """Tensors of modules, and how often each was changed.

    Read without a Python loop, which would take as long as a step of one state.
    """

    def __init__(self, owners: Sequence[dict]) -> None:
        found = [(owner, name, one) for owner in owners for name, one in owner.items() if one is not None]
        found = [each for each in found if each[1] not in _FOLLOWING]
        # PyTorch counts no changes of tensors made in inference mode: they are never the same.
        found = [] if any(one.is_inference() for _, _, one in found) else found
        self.owners, self.names, self.tensors = zip(*found, strict=True) if found else ((), (), ())
        self.versions = list(map(_VERSION, self.tensors))
        # A module is cast as a whole: one of its tensors tells.
        self.samples = list({id(owner): one for owner, _, one in found}.values())
        self.dtypes = list(map(_DTYPE, self.samples))

    def unchanged(self) -> bool:
        """Whether they are the same tensors with the same numbers; False without any."""
        now = map(dict.get, self.owners, self.names)
        return (
            bool(self.versions)
            and all(map(operator.is_, now, self.tensors))
            and list(map(_VERSION, self.tensors)) == self.versions
            and list(map(_DTYPE, self.samples)) == self.dtypes
        )


_FOLLOWING = ("count", "m2", "inverse_std")  # statistics that change with a normaliser's mean and deviation
_VERSION, _DTYPE = operator.attrgetter("_version"), operator.attrgetter("dtype")


def version_of(tensor: Tensor) -> int:
    """How often a tensor was changed in place; -1 if that is not counted."""
    # PyTorch counts no changes of tensors made in inference mode: they are never the same.
    return -1 if tensor.is_inference() else tensor._version


def is_same(now: Tensor, kept: Tensor, version: int) -> bool:
    """Whether a tensor, perhaps another view, shows the numbers that were kept."""
    return (
        version >= 0
        and now.data_ptr() == kept.data_ptr()
        and version_of(now) == version
        and (now.shape, now.stride(), now.dtype) == (kept.shape, kept.stride(), kept.dtype)
    )
