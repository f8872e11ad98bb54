"""Functions of tensors recorded as CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

_WARM_UP = 2  # calls before recording, in which libraries choose their algorithms


class StepGraph:
    """A CUDA graph of a function: copy to ``inputs``, :meth:`replay`, read ``outputs``."""

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], inputs: Sequence[Tensor]) -> None:
        self.inputs = list(inputs)
        before = [each.clone() for each in self.inputs]
        with torch.cuda.device(self.inputs[0].device):
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UP):
                    function(*self.inputs)
            torch.cuda.current_stream().wait_stream(stream)
            for each, value in zip(self.inputs, before, strict=True):
                each.copy_(value)
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self.outputs = function(*self.inputs)

    def replay(self) -> None:
        self._graph.replay()
