"""A planner's plan as an entry of the TensorDict, so that planners keep nothing themselves."""

from __future__ import annotations

from abc import abstractmethod
from numbers import Integral
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.planners.common import MPCPlannerBase

from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.envs.scene_env import SceneEnv

# An entry that an environment does not know stays as it is from step to step, and so does a primer's, which also sets
# it back when an episode begins.
KEY = "plan"


class RecedingHorizonPlanner(MPCPlannerBase):
    """A planner whose plan is the TensorDict's entry ``plan``."""

    @abstractmethod
    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        """The action ``[*B, A]`` to take now, and what is to be written beside it."""

    def planning(self, td: TensorDictBase) -> Tensor:
        """The action ``[*B, A]`` to take now."""
        return self.decide(td)[0]

    def forward(
        self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None, **kwargs: Any
    ) -> TensorDictBase:
        """Plan, and write the action and what is left of the plan.

        Raises:
            ValueError: if there are other arguments.
        """
        if kwargs:
            raise ValueError(f"{type(self).__name__} takes no {', '.join(kwargs)}.")
        action, beside = self.decide(tensordict)
        written = self._write_to_tensordict(tensordict, [self.action_spec.project(action)], tensordict_out)
        for key, value in beside.items():
            written.set(key, value)
        return written


def check_plannable(env: ModelEnv | SceneEnv, **counts: int) -> None:
    """Refuse what no planner can plan with.

    Args:
        env: the environment to plan in; it needs a reward and actions with bounds. Equal ones fix an action.
        **counts: what must be at least 1, by name.

    Raises:
        ValueError: naming what is wrong.
    """
    for name, value in counts.items():
        check_count(name, value, 1)
    scene = env.scene
    if env.reward is None:
        raise ValueError(f"{env} has no reward to plan for; give it one, as make_reward(task, scene).")
    if scene.num_actions == 0:
        raise ValueError(f"Scene {scene.name!r} has no actions to plan.")
    if not (np.isfinite(scene.action_low) & np.isfinite(scene.action_high)).all():
        raise ValueError(f"Scene {scene.name!r} has actions without bounds; give its motors a ctrlrange.")
    if (scene.action_low > scene.action_high).any():
        worst = int((scene.action_low - scene.action_high).argmax())
        raise ValueError(
            f"Scene {scene.name!r} has its action {worst} between {scene.action_low[worst]:g} and"
            f" {scene.action_high[worst]:g}: action_low must not be above action_high."
        )


def check_count(name: str, value: int, least: int) -> None:
    """Refuse what is no count, before a plan trips over it.

    Args:
        name: of the argument, for the message.
        value: what was given.
        least: the lowest that will do.

    Raises:
        ValueError: it is no whole number, or below the least.
    """
    if not isinstance(value, Integral):
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")


def read_plan(tensordict: TensorDictBase, shape: tuple[int, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The sequence of actions to go on from, and whether there is one.

    Args:
        tensordict: ``[*B]``.
        shape: of a sample's sequences, ``(..., H, A)``.
        dtype: of the actions.

    Returns:
        Actions ``[*B, *shape]``, zeros where there are none, and ``[*B, 1]`` bool, whether they were planned.

    Raises:
        ValueError: if they have another shape: the plan of another planner or horizon.
    """
    batch = tensordict.shape
    plan = cast("TensorDictBase | None", tensordict.get(KEY, None))
    if plan is None:
        empty = torch.zeros(*batch, *shape, dtype=dtype, device=tensordict.device)
        return empty, torch.zeros(*batch, 1, dtype=torch.bool, device=tensordict.device)
    actions, planned = cast(Tensor, plan.get("actions")), cast(Tensor, plan.get("planned"))
    if actions.shape != (*batch, *shape):
        raise ValueError(
            f"The TensorDict's plan is {list(actions.shape)}, this planner's is {[*batch, *shape]}: it comes from"
            " another planner. Drop the entry 'plan', or give every planner its own episodes."
        )
    return actions.to(dtype), planned


def plan_left(batch: torch.Size, actions: Tensor, **more: Tensor) -> TensorDict:
    """The entry ``plan`` when the first action was taken, with the last one repeated.

    Args:
        batch: ``[*B]``.
        actions: ``[*B, ..., H, A]``.
        **more: what else the planner wants to find there at the next step, ``[*B, ...]``.
    """
    left = torch.cat([actions[..., 1:, :], actions[..., -1:, :]], dim=-2)
    planned = torch.ones(*batch, 1, dtype=torch.bool, device=actions.device)
    return TensorDict({"actions": left, "planned": planned, **more}, batch_size=batch)


def plan_primer(
    shape: tuple[int, ...],
    dtype: torch.dtype,
    device: torch.device | None,
    hidden_state: TensorDictBase | None = None,
    **more: tuple[int, ...],
) -> TensorDictPrimer:
    """Transform that clears the plan when an episode begins; append it to the environment that is acted in.

    Args:
        shape: of a sample's sequences, ``(..., H, A)``.
        dtype: of the actions.
        device: of the environment.
        hidden_state: what a recurrent model remembers of nothing, zeros, to clear too.
        **more: shapes of a sample's other entries of the plan.
    """
    entries = {key: Unbounded(shape=torch.Size(of), dtype=dtype, device=device) for key, of in more.items()}
    entries["actions"] = Unbounded(shape=torch.Size(shape), dtype=dtype, device=device)
    entries["planned"] = Unbounded(shape=torch.Size([1]), dtype=torch.bool, device=device)
    specs = {KEY: Composite(entries)}
    if hidden_state is not None:
        of = {
            str(key): Unbounded(shape=value.shape, dtype=value.dtype, device=device)
            for key, value in hidden_state.items()
        }
        specs["hidden_state"] = Composite(of)
    return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)
