"""The MLP that policies and values use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_gn.maths.normalizer import Normalizer, unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import dtype_of
from torchrl_gn.networks.foldable import is_plain


class LayerNormMLP(nn.Module):
    """MLP whose first layer is normalised and bounded, as in D4PG and its successors (Barth-Maron et al. 2018).

    Observations of bodies differ widely in scale. Without normalisation, an overestimated value drives a policy into
    the saturation of its squashing function, where gradients vanish.

    Args:
        linear: whether to add a linear map of the inputs, initialised to 0. The output is then unbounded.

    Raises:
        ValueError: without a hidden size.
    """

    def __init__(self, in_features: int, out_features: int, hidden: Sequence[int], *, linear: bool = False) -> None:
        super().__init__()
        if not hidden:
            raise ValueError("hidden=[] must name at least one hidden size.")
        first, *further = hidden
        self.first = nn.Sequential(nn.Linear(in_features, first), nn.LayerNorm(first), nn.Tanh())
        self.rest = MLP(first, out_features, num_cells=further, activation_class=nn.SiLU)
        self.linear = nn.Linear(in_features, out_features, bias=False) if linear else None
        if self.linear is not None:
            nn.init.zeros_(self.linear.weight)

    @without_autocast
    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the output ``[*B, out_features]`` for inputs ``[*B, F_k]``, concatenated, in their dtype."""
        together = torch.cat(inputs, dim=-1)
        features = together.to(dtype_of(self.first))
        output = self.rest(self.first(features))
        return (output if self.linear is None else output + self.linear(features)).to(together.dtype)


@torch.no_grad()
def renormalize(
    networks: Sequence[LayerNormMLP], normalizer: Normalizer, values: Tensor, *, constant: float = 0.0
) -> None:
    """Refit the output normaliser to new values ``[*B, 1]``; adapt the last layers so that predictions stay the same.

    This is Pop-Art (van Hasselt et al. 2016), for values that grow during training.

    Args:
        constant: standard deviation to assume if all values are equal; 0: the networks then predict that value.

    Raises:
        ValueError: a last layer is not linear any more, or has a hook, pruning or a parametrisation.
    """
    outputs = [
        [cast(nn.Linear, each) for each in (network.rest[-1], network.linear) if each is not None]
        for network in networks
    ]
    if changed := [each for layers in outputs for each in layers if not is_plain(each)]:
        raise ValueError(
            f"The last layer of a network, {type(changed[0]).__name__}, was changed (adapter, hook, pruning,"
            " parametrisation), so that predictions would not stay the same on another scale: leave last layers as they"
            " are."
        )
    before, std = normalizer.mean.clone(), normalizer.std.clone()
    values = values.reshape(-1, 1).to(before)
    with unchanged_on_error(normalizer):
        normalizer.reset()
        normalizer.update(values)
        if constant and bool(normalizer.constant):
            away = constant * (len(values) / 2 + 1) ** 0.5
            normalizer.update(values.mean() + torch.tensor([[-away], [away]]).to(values))
    for layers in outputs if bool((std > 0) & (normalizer.std > 0)) else ():
        for layer in layers:
            layer.weight.mul_((std / normalizer.std).to(layer.weight.dtype))
        last = layers[0]
        last.bias.copy_((last.bias * std + before - normalizer.mean) / normalizer.std)
