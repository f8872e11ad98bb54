"""A bound on what a policy gives to its squashing function."""

from __future__ import annotations

from torch import Tensor, nn


class OutputNormalization(nn.Module):
    r"""Location :math:`\mu / \sqrt{1 + \overline{\mu^2}}`, with a mean square of at most 1.

    A value that always asks for more drives a policy far into the flat ends of its tanh, the more so under Adam, which
    makes up for small gradients; what is drawn there hardly varies, and nothing else is tried again. Wang et al. 2020
    ("Striving for simplicity") divide by the mean magnitude where that is above 1, which leaves a single action without
    any gradient there; this is the same, smoothly.
    """

    def forward(self, location: Tensor) -> Tensor:
        """Bounded locations ``[*B, A]``."""
        return location * (1 + location.square().mean(-1, keepdim=True)).rsqrt()
