"""A planner's plan as an entry of the TensorDict, which keeps planners stateless."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.planners.common import MPCPlannerBase

from torchrl_gn.checks import check_count, check_counts
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.envs.scene_env import SceneEnv
from torchrl_gn.maths.precision import without_autocast

# Environments carry unknown entries from step to step; a primer also resets this one when an episode begins.
KEY = "plan"
INIT = "is_init"  # of TorchRL's InitTracker: True where an episode begins
_TOLERANCE = 1e-2  # of a control step


class RecedingHorizonPlanner(MPCPlannerBase):
    """A planner whose plan is the TensorDict's entry ``plan``."""

    @abstractmethod
    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        """Return the next action ``[*B, A]`` and the other entries to write."""

    def planning(self, td: TensorDictBase) -> Tensor:
        return self.decide(td)[0]

    @without_autocast
    def forward(
        self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None, **kwargs: Any
    ) -> TensorDictBase:
        """Write the action and the remaining plan; other arguments raise ValueError."""
        if kwargs:
            raise ValueError(f"{type(self).__name__} takes no {', '.join(kwargs)}.")
        action, entries = self.decide(tensordict)
        written = self._write_to_tensordict(tensordict, [self.action_spec.project(action)], tensordict_out)
        for key, value in entries.items():
            written.set(key, value)
        return written


def check_plannable(env: ModelEnv | SceneEnv, warm_up: int | None, **counts: int) -> None:
    """Raise ValueError unless ``env`` has a reward and bounded actions, ``counts`` are >= 1 and ``warm_up`` is >= 0."""
    check_counts(**counts)
    if warm_up is not None:
        check_count("warm_up", warm_up, 0)
    scene = env.scene
    if env.reward is None:
        raise ValueError(f"{env} has no reward to plan for; give it one, such as make_reward(task, scene).")
    if scene.num_actions == 0:
        raise ValueError(f"Scene {scene.name!r} has no actions to plan.")
    if scene.unbounded:
        raise ValueError(
            f"Scene {scene.name!r} has actions without bounds, {list(scene.unbounded)}: give their actuators a"
            " ctrlrange, or load it with action_bounds={name: (low, high)}."
        )
    if (scene.action_low > scene.action_high).any():
        worst = int((scene.action_low - scene.action_high).argmax())
        raise ValueError(
            f"Scene {scene.name!r} has its action {worst} between {scene.action_low[worst]:g} and"
            f" {scene.action_high[worst]:g}: action_low must not be above action_high."
        )


def flat_rows(tensordict: TensorDictBase) -> TensorDictBase:
    """Flatten the batch of a TensorDict ``[*B]`` to one dimension; ``reshape(-1)`` refuses an empty batch."""
    return tensordict.reshape(math.prod(tensordict.shape))


def repeated(rows: TensorDictBase, count: int) -> TensorDictBase:
    """Repeat each of the rows ``[B]`` ``count`` times; copies of a row are adjacent."""
    return rows if count == 1 else rows.repeat_interleave(count, dim=0)


def keep_better(best: Tensor, best_return: Tensor, actions: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Update the best candidates and their returns; returns that are not finite never win."""
    better = total.isfinite() & (total > best_return)
    return torch.where(better[..., None, None], actions, best), torch.where(better, total, best_return)


def device_of(tensordict: TensorDictBase) -> torch.device | None:
    """Return the device of the entry ``state`` or ``physics``, else of the TensorDict."""
    state = cast("Tensor | None", tensordict.get("state", tensordict.get("physics", None)))
    return tensordict.device if state is None else state.device


def read_plan(
    tensordict: TensorDictBase, shape: tuple[int, ...], dtype: torch.dtype, timestep: float
) -> tuple[Tensor, Tensor]:
    """Return planned actions ``[*B, *shape]``, zeros without a plan, and a mask ``[*B, 1]`` of samples with a plan.

    A plan of an earlier episode does not count, see :func:`of_this_episode`. ValueError if the plan has another shape,
    or if the time in ``physics`` is not one ``timestep``, seconds, after the plan's time.
    """
    batch = tensordict.shape
    plan = cast("TensorDictBase | None", tensordict.get(KEY, None))
    if plan is None:
        device = device_of(tensordict)
        empty = torch.zeros(*batch, *shape, dtype=dtype, device=device)
        return empty, torch.zeros(*batch, 1, dtype=torch.bool, device=device)
    actions = cast(Tensor, plan.get("actions"))
    if actions.shape != (*batch, *shape):
        raise ValueError(
            f"The TensorDict's plan is {list(actions.shape)}, this planner's is {[*batch, *shape]}: it comes from"
            " another planner. Delete the entry 'plan', or give every planner its own episodes."
        )
    return actions.to(dtype), of_this_episode(tensordict, plan, timestep)


def of_this_episode(tensordict: TensorDictBase, entry: TensorDictBase, timestep: float) -> Tensor:
    """Return a mask ``[*B, 1]`` of samples whose ``entry`` has been ``planned`` in the running episode.

    An earlier episode planned it where ``is_init`` (TorchRL's ``InitTracker``) is True, or where the time in
    ``physics`` is before its ``time``, as after a reset. ValueError if a later time is not one control step after its
    ``time``.
    """
    planned, begins = cast(Tensor, entry.get("planned")), cast("Tensor | None", tensordict.get(INIT, None))
    if begins is not None:
        planned = planned & ~begins.reshape(planned.shape).to(planned.device)
    before, physics = entry.get("time", None), cast("Tensor | None", tensordict.get("physics", None))
    if before is None or physics is None:
        return planned
    now = time_of(tensordict)
    passed = now - before
    tolerance = _TOLERANCE * timestep + 4 * torch.finfo(physics.dtype).eps * now.abs()
    wrong = planned & (passed > tolerance) & ((passed - timestep).abs() > tolerance)
    if bool(wrong.any()):
        raise ValueError(
            f"{1e3 * float(passed[wrong][0]):.4g} ms have passed in 'physics' since the plan was made, but a control"
            f" step of the planner's scene takes {1e3 * timestep:.4g} ms. Give the scenes of planner and environment"
            " the same timestep=, plan at every control step, and append the planner's make_tensordict_primer() to the"
            " environment, or delete the entry 'plan' when an episode begins."
        )
    return planned & (passed >= -tolerance)


def time_of(tensordict: TensorDictBase) -> Tensor:
    """Return MuJoCo's time ``[*B, 1]``, float64, the first number of ``physics``; zeros without that entry."""
    physics = cast("Tensor | None", tensordict.get("physics", None))
    if physics is None:
        return torch.zeros(*tensordict.shape, 1, dtype=torch.float64, device=device_of(tensordict))
    return physics[..., :1].detach().double()


def shift_plan(tensordict: TensorDictBase, actions: Tensor, **more: Tensor) -> TensorDict:
    """Make the entry ``plan`` of a TensorDict ``[*B]``, for its next step.

    It has ``actions`` ``[*B, ..., H, A]`` shifted by a step, the last repeated, the time, and ``more``.
    """
    batch = tensordict.shape
    shifted = torch.cat([actions[..., 1:, :], actions[..., -1:, :]], dim=-2)
    planned = torch.ones(*batch, 1, dtype=torch.bool, device=actions.device)
    entries = {"actions": shifted, "planned": planned, "time": time_of(tensordict).to(actions.device)}
    return TensorDict({**entries, **more}, batch_size=batch)


def plan_primer(
    shape: tuple[int, ...],
    dtype: torch.dtype,
    device: torch.device | None,
    carried: Mapping[str, TensorSpec] | None = None,
    **more: tuple[int, ...],
) -> TensorDictPrimer:
    """Make a transform that resets the plan when an episode begins; append it to the real environment.

    Args:
        shape: shape of a sample's sequences, ``(..., H, A)``.
        carried: specs of entries that the model carries from step to step; they are reset to zeros, too.
        more: shapes of other entries of the plan.
    """
    shapes = {**more, "actions": shape}
    entries = {key: Unbounded(shape=torch.Size(shape), dtype=dtype, device=device) for key, shape in shapes.items()}
    entries["planned"] = Unbounded(shape=torch.Size([1]), dtype=torch.bool, device=device)
    entries["time"] = Unbounded(shape=torch.Size([1]), dtype=torch.float64, device=device)
    specs = {KEY: Composite(entries), **(carried or {})}
    return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)
