"""A policy that hands over to a fallback where its model is not trusted."""

from __future__ import annotations

import itertools
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.dynamics.ensemble import BoundEnsemble
from torchrl_gn.envs.model_env import ModelEnv, checked_trust
from torchrl_gn.planners.plan import RecedingHorizonPlanner
from torchrl_gn.planners.plan_ahead import PlanAhead
from torchrl_gn.scenes.articulation import Articulation, require_same_nodes

_PLANNERS = (RecedingHorizonPlanner, PlanAhead)  # they carry an entry 'plan'


class Guarded(TensorDictModuleBase):
    """Policy or planner with a fallback for actions whose outcome the ensemble doubts.

    Writes ``action``, the ``doubt`` ``[*B, 1]`` of the policy's action, and ``guarded`` ``[*B, 1]``, True where the
    fallback acts. Both modules run at every step, so that a plan stays up to date. A planner continues with the past
    actions and hidden states that follow the executed action.

    Args:
        policy: module, for example a planner, that writes ``action`` from the entries of an environment of the
            ensemble's scene.
        fallback: another such module, for example a controller that needs no model.
        ensemble: a calibrated ensemble.
        trust: highest accepted :meth:`~torchrl_gn.dynamics.BoundEnsemble.doubt`; 1 is typical of the calibration data.

    Raises:
        RuntimeError: if the ensemble is not calibrated.
        TypeError: if a module does not write ``action``.
        ValueError: if ``trust`` is not positive, if a module is of a scene with other bodies or joints, or if both
            modules are planners that carry a plan, as they would share its entry.
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
        planners = [[each for each in module.modules() if isinstance(each, _PLANNERS)] for module in (policy, fallback)]
        if all(planners):
            raise ValueError(
                f"policy and fallback would share the entry 'plan': {type(planners[0][0]).__name__} and"
                f" {type(planners[1][0]).__name__} both carry one. Use a fallback without a plan, such as a controller"
                " or TorchRL's CEMPlanner."
            )
        self.policy, self.fallback, self.ensemble = policy, fallback, ensemble
        self.trust = checked_trust(trust, ensemble)
        for part in itertools.chain(policy.modules(), fallback.modules()):
            scene = getattr(part.env if isinstance(part, RecedingHorizonPlanner) else part, "scene", None)
            if isinstance(scene, Articulation):
                require_same_nodes(ensemble.scene, scene, type(part).__name__)
        self._past: list[NestedKey] = ["past_actions"] if getattr(ensemble.scene, "history", 0) else []
        reads = dict.fromkeys(("state", *self._past, *policy.in_keys, *fallback.in_keys))
        self.in_keys: list[NestedKey] = list(reads)
        writes = dict.fromkeys((*policy.out_keys, *fallback.out_keys, "doubt", "guarded"))
        self.out_keys: list[NestedKey] = list(writes)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the actions, the doubt and where the fallback acts."""
        proposed, fallback = (cast(Tensor, act(tensordict)["action"]) for act in (self.policy, self.fallback))
        past, state = [tensordict[key].flatten(-2) for key in self._past], cast(Tensor, tensordict["state"])
        there = self.ensemble.counted.device
        with torch.no_grad():
            doubt = self.ensemble.doubt(state.to(there), torch.cat((proposed, *past), -1).to(there))
        doubt = doubt.unsqueeze(-1).to(state.device)
        guarded = ~(doubt <= self.trust)
        tensordict.update({"action": torch.where(guarded, fallback, proposed), "doubt": doubt, "guarded": guarded})
        return self._carry_on(tensordict)

    def _carry_on(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the models' past actions and hidden states after the executed action, for each planner's next step."""
        device = tensordict["state"].device
        for planner in (each for each in self.modules() if isinstance(each, _PLANNERS)):
            env = planner.env if isinstance(planner, RecedingHorizonPlanner) else planner.planner.env
            if isinstance(env, ModelEnv) and env.carried_keys:
                with torch.no_grad():
                    for key, value in env.carried(tensordict.exclude("next").to(env.device)).items():
                        tensordict.set(("next", key), value.to(device))
        return tensordict
