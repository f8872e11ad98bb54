"""A policy that hands over to a fallback where its model is not trusted."""

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
    """Policy or planner with a fallback for actions whose outcome the ensemble doubts.

    Writes ``action``, the ``doubt`` ``[*B, 1]`` of the policy's action, and ``guarded`` ``[*B, 1]``, True where the
    fallback acts. Both modules run at every step, so that their plans and hidden states stay up to date.

    Args:
        policy: module, for example a planner, that writes ``action`` from the entries of an environment of the
            ensemble's scene.
        fallback: another such module, for example a controller that needs no model.
        ensemble: a calibrated ensemble.
        trust: highest accepted :meth:`~torchrl_gn.dynamics.BoundEnsemble.doubt`; 1 is typical of the calibration data.

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
        """Write the actions, the doubt and where the fallback acts."""
        wanted, safe = (cast(Tensor, act(tensordict)["action"]) for act in (self.policy, self.fallback))
        past = [tensordict[key].flatten(-2) for key in self._past]
        with torch.no_grad():
            doubt = self.ensemble.doubt(tensordict["state"], torch.cat((wanted, *past), -1)).unsqueeze(-1)
        guarded = ~(doubt <= self.trust)
        tensordict.update({"action": torch.where(guarded, safe, wanted), "doubt": doubt, "guarded": guarded})
        return tensordict
