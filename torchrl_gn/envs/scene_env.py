"""The true physics of a scene as a TorchRL environment."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.drawing import draw_states
from torchrl_gn.envs.partial_steps import step_some
from torchrl_gn.envs.specs import DoneFunction, RewardFunction, finite_reward, outcome, read, reward_of, set_specs
from torchrl_gn.envs.starts import StartSampler, StartStates
from torchrl_gn.envs.terminal import TerminalValue, step_entries, terminal_of
from torchrl_gn.envs.transform_checks import note_output, refuse_transforms
from torchrl_gn.finite import require_finite
from torchrl_gn.scenes.articulation import require_bodies
from torchrl_gn.scenes.load import as_scene
from torchrl_gn.scenes.scene import Scene


class SceneEnv(EnvBase):
    """MuJoCo simulation of a scene, stateless and batched over any leading batch; not differentiable.

    Entries:
        - ``state`` ``[*B, N, 13]`` float64: position, w-first quaternion, linear and angular velocity; world frame.
        - ``physics`` ``[*B, S]`` float64: full MuJoCo state (``mjSTATE_FULLPHYSICS``), which a step starts from.
        - ``action`` ``[*B, A]``: float32 in the spec, float64 accepted. MuJoCo clamps limited controls.
        - ``variant`` ``[*B, 1]`` int64, with several scenes only: index of the sample's scene.
        - ``done``, ``terminated`` ``[*B, 1]``: True if ``done`` ends the episode, or if the simulation became unstable;
          the state is then the last good one.

    ``reset()`` draws start states for the TensorDict's batch; ``reset(tensordict, set_state=True)`` starts from its
    ``physics``. For collectors see :func:`~torchrl_gn.envs.batched`.

    Args:
        scene: a scene, an argument of :func:`~torchrl_gn.scenes.load_scene` (``"pendulum"``), or variants of one scene.
            A batch cycles through variants, or follows the TensorDict's ``variant``. If it is smaller than their
            number, such as a single episode, each reset draws them at random.
        reward: function ``(state, action, next_state, task) -> [*B, 1]``; zero without one.
        done: function from the state after a step ``[*B, N, 13]`` to bool ``[*B]`` or ``[*B, 1]``, True where the
            episode ends; or a TensorDict module that reads the step's entries and writes ``terminated``.
        terminal: function that returns values ``[*B, 1]`` of a plan's last states ``[*B, N, 13]``, for environments to
            plan on. Its attribute ``discount``, if any, discounts the plan's rewards. The rewards of steps then sum to
            a plan's return minus a constant, see :func:`~torchrl_gn.envs.terminal.step_entries`. If the reward has a
            target, ``terminal`` must read the task, as :class:`~torchrl_gn.planners.TerminalReward` does.
        start_states: full MuJoCo states ``[M, S]``, or ``(n, generator) -> [n, S]``. Default: the system's own.
        unstable_reward: reward of a step that becomes unstable. Default: -1e6, which no planner accepts; under
            :func:`~torchrl_gn.envs.batched`, where policies learn, 100 times the reward of staying in the last good
            state if that is negative, else 0.
        device: device of the TensorDicts; the simulation runs on the CPU.

    Example:
        >>> start = (env := SceneEnv("pendulum", seed=0)).reset(TensorDict(batch_size=[5]))
        >>> env.rollout(20, tensordict=start, auto_reset=False)["next", "reward"].shape
        torch.Size([5, 20, 1])
    """

    _supports_set_state = True

    def __new__(cls, *args, **kwargs):
        return super().__new__(cls, *args, _batch_locked=False, **kwargs)

    def __init__(
        self,
        scene: Scene | str | os.PathLike | mujoco.MjSpec | Sequence[Scene],
        reward: RewardFunction | None = None,
        *,
        done: DoneFunction | None = None,
        terminal: TerminalValue | None = None,
        start_states: StartStates | None = None,
        num_threads: int | None = None,
        unstable_reward: float | None = None,
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ):
        super().__init__(device=device)
        scenes = as_scene(scene)
        self.scenes = tuple(
            require_bodies(each, "A simulation") for each in (scenes if isinstance(scenes, list) else [scenes])
        )
        self.scene = self.scenes[0]
        self.reward = reward_of(reward, self, self.scene)
        self.num_threads = num_threads
        self.ends = done
        self.terminal = terminal_of(terminal, self, self.scene)
        self.unstable_reward, self.spares_learners = finite_reward(unstable_reward), unstable_reward is None
        self.starts = StartSampler(self.scene, start_states, seed)
        self._simulator: Simulator | None = None
        set_specs(self, self.scene, physics=True, variants=len(self.scenes))

    @property
    def simulator(self) -> Simulator:
        self._simulator = self._simulator or Simulator(self.scenes, num_threads=self.num_threads)
        return self._simulator

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_) -> TensorDict:
        tensordict = TensorDict(batch_size=self.batch_size) if tensordict is None else tensordict
        shape = tensordict.shape
        if len(self.scenes) > 1 and tensordict.get("variant", None) is None:
            variants = self.starts.draw_variants(shape.numel(), len(self.scenes))
            tensordict = tensordict.copy().set("variant", variants.reshape(*shape, 1))
        variant = self.variant_of(tensordict)
        if set_state and ("physics" in tensordict.keys() or variant is None):
            physics = read(tensordict, "physics", (self.scene.physics_size,), self)
            require_finite(physics, f"{self}: 'physics'")
            physics = physics.cpu().to(torch.float64, copy=True)
        else:
            physics = self.starts.draw(shape, tensordict.get("_reset", None), variant, simulator=self.simulator)
        which = None if variant is None else variant.squeeze(-1)
        entries = {"state": self.simulator.observe(physics, which), "physics": physics}
        if variant is not None:
            entries["variant"] = variant
        if self.terminal is not None:
            entries["discount"] = torch.ones(*shape, 1, dtype=torch.float32)
        note_output(self, physics, reset=True)
        return TensorDict(entries, batch_size=shape).to(self.device)

    def variant_of(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return the index ``[*B, 1]`` of each sample's variant, on the CPU; None for a single scene."""
        if len(self.scenes) == 1:
            return None
        variant = read(tensordict, "variant", (1,), self).cpu()
        if variant.dtype != torch.int64 or not bool(((variant >= 0) & (variant < len(self.scenes))).all()):
            raise ValueError(f"{self}: 'variant' must be int64 in [0, {len(self.scenes)}), got {variant.flatten()[:5]}")
        return variant

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        refuse_transforms(self, tensordict, "physics")
        stepped = step_some(tensordict, self._step_all)
        note_output(self, cast(Tensor, stepped["physics"]), reset=False)
        return stepped

    def _step_all(self, tensordict: TensorDictBase) -> TensorDict:
        physics = read(tensordict, "physics", (self.scene.physics_size,), self)
        action = read(tensordict, "action", (self.scene.num_actions,), self).detach()
        require_finite(physics, f"{self}: 'physics'")
        require_finite(action, f"{self}: 'action'")
        controls = action.unsqueeze(-2).cpu().to(torch.float64)
        variant = self.variant_of(tensordict)
        which = None if variant is None else variant.squeeze(-1)
        simulated = self.simulator.rollout(physics.detach().cpu(), controls, which)
        # Move entries one by one: TensorDict.to costs as much as a small simulation.
        stable = simulated["stable"].to(self.device).unsqueeze(-1)
        state, next_state = simulated["state"].to(self.device).unbind(-3)
        after = torch.where(stable, simulated["physics"][..., 1, :].to(self.device), physics.detach())
        entries = outcome(self, tensordict, state, action, next_state, stable, physics=after)
        entries |= step_entries(self, tensordict, state, entries)
        if variant is not None:
            entries["variant"] = variant.to(self.device, copy=True)
        return TensorDict(entries, batch_size=tensordict.shape, device=self.device)

    def render(self, tensordict: TensorDictBase, *, size: int = 360) -> np.ndarray:
        """Render images ``[*B, size, size, 3]`` uint8 of the TensorDict's ``state``; needs Pillow, but no display."""
        state = read(tensordict, "state", (self.scene.num_nodes, self.scene.state_size), self)
        if (variant := self.variant_of(tensordict)) is None:
            return draw_states(self.scene, state, size=size)
        pictures = np.empty((*tensordict.shape, size, size, 3), dtype=np.uint8)
        for index in variant.unique().tolist():
            selected = (variant == index).squeeze(-1)
            pictures[selected.numpy()] = draw_states(self.scenes[index], state.cpu()[selected], size=size)
        return pictures

    def _set_seed(self, seed: int | None) -> None:
        self.starts.seed(seed)

    def __repr__(self) -> str:
        return f"SceneEnv({self.scene.name!r})"

    def __getstate__(self) -> dict:
        # Copies and worker processes start their own threads and MuJoCo data.
        return {**super().__getstate__(), "_simulator": None}
