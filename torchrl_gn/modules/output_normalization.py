"""A bound on what a policy gives to its squashing function."""

from __future__ import annotations

from torch import Tensor, nn


class OutputNormalization(nn.Module):
    """Divide by the mean magnitude where that is above 1 (Wang et al. 2020, "Striving for simplicity").

    A value that always asks for more drives a policy far into the flat ends of its tanh, the more so under Adam, which
    makes up for small gradients; what is drawn there hardly varies, and nothing else is tried again.
    """

    def forward(self, location: Tensor) -> Tensor:
        """``[*B, A]`` with a mean magnitude of at most 1."""
        return location / location.abs().mean(-1, keepdim=True).clamp(min=1)
