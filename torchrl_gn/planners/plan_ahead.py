"""A wrapper that hides a planner's latency: it plans for a later step while earlier actions are executed."""

from __future__ import annotations

import concurrent.futures
import copy
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, TensorDictPrimer
from torchrl.modules.planners.common import MPCPlannerBase

from torchrl_gn.checks import check_count
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.envs.scene_env import SceneEnv
from torchrl_gn.planners.plan import INIT, device_of, of_this_episode, time_of
from torchrl_gn.planners.plan import KEY as PLAN

KEY = "ahead"
# Entries of a step; a plan starts without them.
_OF_STEPS = ("reward", "discount", "done", "terminated", "truncated")


class PlanAhead(TensorDictModuleBase):
    """Planner for the state ``delay`` control steps ahead, which hides the planner's latency.

    The next ``delay`` actions are committed. Every control step executes the first of them, predicts the state after
    all of them, and plans from there; the plan's first action is committed next. A plan may thus take ``delay`` control
    steps; the price is the model's prediction error over that time. The first plans of an episode are made before the
    robot moves.

    By default the planner runs in turn with the environment, for any batch, and the delay is simulated. With
    ``background``, the planner runs in a thread beside the caller. The actions are the same, and the loop keeps the
    control rate as long as a plan takes no longer than one pass of it. All episodes of a batch must then begin
    together; :attr:`late` counts the steps that waited for a plan. A planner on a
    :class:`~torchrl_gn.envs.SceneEnv` is copied for the thread.

    Reads the planner's inputs, and ``ahead`` if present; writes ``action``, the planner's outputs, and ``ahead``:
    committed ``actions`` ``[*B, delay, A]``, ``planned`` ``[*B, 1]`` bool, and the ``time`` ``[*B, 1]`` of ``physics``.
    If episodes auto-reset, append :meth:`make_tensordict_primer` to the environment.

    Args:
        planner: a planner of this library, or TorchRL's CEM or MPPI; its ``env`` predicts the states.
        delay: control steps that a plan may take, at least 1.
        background: plan in a thread.

    Raises:
        TypeError: ``planner`` is not a planner.
        ValueError: ``delay`` is below 1; when planning, if ``physics`` has moved on by another time than a control
            step; or, with ``background``, if episodes of a batch do not begin together.

    Example:
        >>> from torchrl_gn.envs import SceneEnv
        >>> from torchrl_gn.planners import ILQGPlanner, PlanAhead
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("pendulum")
        >>> env = SceneEnv(scene, make_reward("balance", scene), seed=0)
        >>> planner = PlanAhead(ILQGPlanner(env, horizon=10, iterations=1), delay=2)
        >>> env.rollout(3, planner)["action"].shape
        torch.Size([3, 1])
    """

    def __init__(self, planner: MPCPlannerBase, delay: int = 1, *, background: bool = False) -> None:
        super().__init__()
        if not isinstance(planner, MPCPlannerBase):
            raise TypeError(f"PlanAhead needs a planner with an environment, got {type(planner).__name__}.")
        check_count("delay", delay, 1)
        if background and isinstance(planner.env, SceneEnv):
            planner = copy.deepcopy(planner)  # the caller may step the same simulator meanwhile
        self.planner, self.delay, self.background = planner, delay, background
        self.in_keys: list[NestedKey] = list(planner.in_keys)
        self.out_keys: list[NestedKey] = [*planner.out_keys, KEY]
        self.late = 0
        self._thread: ThreadPoolExecutor | None = None
        self._coming: list[Future] = []  # pending plans, in the order of their control steps

    def make_tensordict_primer(self) -> Compose:
        """Make the transform for the real environment that resets the plans when an episode begins."""
        planner_primer = getattr(self.planner, "make_tensordict_primer", None)
        spec = cast(TensorSpec, self.planner.action_spec)
        shape = torch.Size((self.delay, *spec.shape[-1:]))
        entries = {
            "actions": Unbounded(shape=shape, dtype=spec.dtype, device=spec.device),
            "planned": Unbounded(shape=torch.Size([1]), dtype=torch.bool, device=spec.device),
            "time": Unbounded(shape=torch.Size([1]), dtype=torch.float64, device=spec.device),
        }
        primer = TensorDictPrimer({KEY: Composite(entries)}, default_value=0.0, expand_specs=True)
        return Compose(*([primer] if planner_primer is None else [planner_primer(), primer]))  # pyright: ignore

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action committed for this step, and commit another."""
        env, device = cast(Any, self.planner.env), device_of(tensordict)
        here = tensordict if device == env.device else tensordict.to(env.device)
        written = self._written(here)
        if isinstance(env, ModelEnv) and env.carried_keys:
            with torch.no_grad():
                for key, value in env.carried(here.copy().update(written)).items():
                    written.set(("next", key), value)
        return tensordict.update(written if here is tensordict else written.to(device))

    def _written(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the entries to write, for a TensorDict on the device of the planner's environment."""
        ahead = cast("TensorDictBase | None", tensordict.get(KEY, None))
        planned = torch.zeros(tensordict.shape, dtype=torch.bool, device="cpu")
        if ahead is not None:
            scene = getattr(self.planner.env, "scene", None)
            timestep = math.inf if scene is None else scene.timestep  # environments without a scene have no physics
            planned = of_this_episode(tensordict, ahead, timestep).squeeze(-1).cpu()
        written = self._in_background(tensordict, planned) if self.background else self._in_turn(tensordict, planned)
        written[KEY, "time"] = time_of(tensordict)
        return written

    def _in_turn(self, tensordict: TensorDictBase, planned: Tensor) -> TensorDictBase:
        """Return the entries to write, where episodes that ``planned`` ``[*B]`` continue and others begin."""
        if planned.all() or not planned.any():
            return self._plan(tensordict, bool(planned.any()))
        flat, rows = tensordict.reshape(-1), [planned.reshape(-1), ~planned.reshape(-1)]
        parts = [self._plan(cast(TensorDictBase, flat[at]), bool(planned.reshape(-1)[at].all())) for at in rows]
        order = torch.cat([at.nonzero().flatten() for at in rows]).argsort()
        return cast(TensorDictBase, torch.cat(cast(Any, parts))[order]).reshape(tensordict.shape)

    def _plan(self, tensordict: TensorDictBase, resumed: bool) -> TensorDictBase:
        """Return the entries to write, if either all episodes continue or all begin."""
        if resumed:
            committed = cast(Tensor, tensordict[KEY, "actions"])
            future = self._after(tensordict, committed)
        else:
            committed, future = self._first_plan(tensordict)
        future = self.planner(future)
        return self._entries(future, torch.cat((committed, future["action"].unsqueeze(-2)), dim=-2))

    def _entries(self, future: TensorDictBase, actions: Tensor) -> TensorDictBase:
        """Return the entries to write: the first of ``actions``, the planner's plan, and the remaining actions."""
        planned = torch.ones(*future.shape, 1, dtype=torch.bool, device=actions.device)
        ahead = TensorDict({"actions": actions[..., 1:, :], "planned": planned}, batch_size=future.shape)
        entries = TensorDict({"action": actions[..., 0, :], KEY: ahead}, batch_size=future.shape)
        return entries.update(future.select(PLAN, strict=False))

    def _first_plan(self, tensordict: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """Plan the first actions ``[*B, delay, A]``; also return the state after them."""
        actions, future = [], tensordict
        for _ in range(self.delay):
            action = self.planner(future.copy())
            actions.append(action["action"])
            future = self._step(action)
        return torch.stack(actions, dim=-2), future

    def _after(self, tensordict: TensorDictBase, actions: Tensor) -> TensorDictBase:
        """Predict the state after ``actions``; the planner's entries stay as they are."""
        future = tensordict.copy()
        for action in actions.unbind(-2):
            future = self._step(future.set("action", action))
        return future

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch.no_grad():
            after = cast(Any, self.planner.env).step(tensordict.exclude("next", KEY))["next"]
        return tensordict.exclude("next", "action", KEY, INIT).update(after.exclude(*_OF_STEPS))

    def _in_background(self, tensordict: TensorDictBase, planned: Tensor) -> TensorDictBase:
        try:
            return self._next_in_background(tensordict, planned)
        except BaseException:
            self._forget()  # an action was taken, or later plans start from one that failed: begin anew
            raise

    def _next_in_background(self, tensordict: TensorDictBase, planned: Tensor) -> TensorDictBase:
        if planned.any() and not planned.all():
            raise ValueError("PlanAhead(background=True) needs episodes that begin together; use background=False.")
        if not (planned.any() and self._coming):
            self.wait()
            self._coming.clear()
            committed, future = self._first_plan(tensordict)
            for action in committed.unbind(-2):
                done: Future = Future()
                done.set_result((action, future))
                self._coming.append(done)
            first_actions = self._coming.pop(0).result()[0]
            self._submit(lambda: future, [])
        else:
            first = self._coming.pop(0)
            self.late += not first.done()
            first_actions = first.result()[0]
            known, before = tensordict.copy(), [*self._coming]

            def ahead() -> TensorDictBase:
                # Runs in the thread, after the plans before this one.
                actions = torch.stack([first_actions, *(each.result()[0] for each in before)], dim=-2)
                plan = before[-1].result()[1] if before else first.result()[1]
                return self._after(known.update(plan.select(PLAN, strict=False)), actions)

            self._submit(ahead, before)
        ones = torch.ones(*tensordict.shape, 1, dtype=torch.bool, device=first_actions.device)
        # The thread has the actions; zeros hold their place in the entry.
        placeholder = first_actions.new_zeros(*first_actions.shape[:-1], self.delay, first_actions.shape[-1])
        entry = TensorDict({"actions": placeholder, "planned": ones}, batch_size=tensordict.shape)
        return TensorDict({"action": first_actions, KEY: entry}, batch_size=tensordict.shape)

    def _submit(self, ahead: Callable[[], TensorDictBase], before: list[Future]) -> None:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="PlanAhead")

        def job() -> tuple[Tensor, TensorDictBase]:
            with torch.no_grad():
                future = self.planner(ahead())
            return future["action"], future

        self._coming.append(self._thread.submit(job))

    def wait(self) -> None:
        """Wait for the plans in the background; re-raise the first error, after which the next step plans anew."""
        try:
            for each in self._coming:
                each.result()
        except BaseException:
            self._forget()
            raise

    def _forget(self) -> None:
        """Drop the plans in the background, once none runs beside the caller."""
        concurrent.futures.wait(self._coming)
        self._coming.clear()

    def __getstate__(self) -> dict:
        return {**super().__getstate__(), "_thread": None, "_coming": []}
