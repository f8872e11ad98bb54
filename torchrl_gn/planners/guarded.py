"""A policy that hands over to another where its model is not to be trusted."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.dynamics.ensemble import BoundEnsemble
from torchrl_gn.envs.model_env import checked_trust


class Guarded(TensorDictModuleBase):
    """Act by a policy or planner, and by a fallback where the ensemble doubts what the action would do.

    Writes ``action``, the ``doubt`` ``[*B, 1]`` of the policy's action, and ``guarded`` ``[*B, 1]``, whether the
    fallback acts. Both policies see every step, so that plans and hidden states go on.

    Args:
        policy: module that writes ``action`` from what an environment of the ensemble's scene writes, say a planner.
        fallback: likewise, a controller that needs no model.
        ensemble: calibrated.
        trust: the highest :meth:`~torchrl_gn.dynamics.BoundEnsemble.doubt`; 1 is usual in the calibration's data.

    Raises:
        RuntimeError: if the ensemble is not calibrated.
        TypeError: if a module does not write ``action``.
        ValueError: if ``trust`` is not positive.
    """

    def __init__(
        self, policy: TensorDictModuleBase, fallback: TensorDictModuleBase, ensemble: BoundEnsemble, *, trust: float
    ) -> None:
        super().__init__()
        for name, module in (("policy", policy), ("fallback", fallback)):
            if "action" not in getattr(module, "out_keys", ()):
                raise TypeError(
                    f"{name} must be a TensorDict module that writes 'action', got {type(module).__name__}."
                )
        self.policy, self.fallback, self.ensemble = policy, fallback, ensemble
        self.trust = checked_trust(trust, ensemble)
        self._past: list[NestedKey] = ["past_actions"] if getattr(ensemble.scene, "history", 0) else []
        reads = dict.fromkeys(("state", *self._past, *policy.in_keys, *fallback.in_keys))
        self.in_keys: list[NestedKey] = list(reads)
        writes = dict.fromkeys((*policy.out_keys, *fallback.out_keys, "doubt", "guarded"))
        self.out_keys: list[NestedKey] = list(writes)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the actions."""
        wanted, safe = (cast(Tensor, act(tensordict)["action"]) for act in (self.policy, self.fallback))
        past = [tensordict[key].flatten(-2) for key in self._past]
        with torch.no_grad():
            doubt = self.ensemble.doubt(tensordict["state"], torch.cat((wanted, *past), -1)).unsqueeze(-1)
        guarded = ~(doubt <= self.trust)
        tensordict.update({"action": torch.where(guarded, safe, wanted), "doubt": doubt, "guarded": guarded})
        return tensordict
