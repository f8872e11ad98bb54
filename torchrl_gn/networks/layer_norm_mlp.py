"""The MLP of policies and values."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import dtype_of


class LayerNormMLP(nn.Module):
    """MLP whose first layer is normalised and bounded, as in D4PG and its successors (Barth-Maron et al. 2018).

    Observations of bodies have all sorts of scales, and an overestimated value drives a policy on them into the flat
    ends of its squashing function, where nothing is learned any more. ValueError without a hidden size.
    """

    def __init__(self, in_features: int, out_features: int, hidden: Sequence[int]) -> None:
        super().__init__()
        if not hidden:
            raise ValueError("hidden=[] must name at least one hidden size.")
        first, *rest = hidden
        self.first = nn.Sequential(nn.Linear(in_features, first), nn.LayerNorm(first), nn.Tanh())
        self.rest = MLP(first, out_features, num_cells=rest, activation_class=nn.SiLU)

    @without_autocast
    def forward(self, *inputs: Tensor) -> Tensor:
        """Output ``[*B, out_features]`` of inputs ``[*B, F_k]`` side by side, in their dtype."""
        together = torch.cat(inputs, dim=-1)
        return self.rest(self.first(together.to(dtype_of(self.first)))).to(together.dtype)
