"""The true physics of a scene as a TorchRL environment."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.envs.specs import RewardFunction, finite_reward, read, reward_of, set_specs, step_reward
from torchrl_gn.envs.starts import StartSampler, StartStates
from torchrl_gn.finite import require_finite
from torchrl_gn.scenes.scene import Scene


class SceneEnv(EnvBase):
    """MuJoCo simulation of a scene, stateless and batched over any leading batch.

    A step is a function of the TensorDict's ``physics`` and ``action`` alone: the same environment steps one state or
    many, TorchRL's planners branch from any TensorDict, and recorded steps replay bit for bit. A batch is simulated by
    MuJoCo's threads in one call. Not differentiable (:class:`~torchrl_gn.envs.ModelEnv` is).

    Entries:
        - ``state`` ``[*B, N, 13]`` float64: position 3, w-first quaternion 4, linear velocity 3,
          angular velocity 3 of each node; SI, world frame.
        - ``physics`` ``[*B, S]`` float64: full MuJoCo state (``mjSTATE_FULLPHYSICS``), which cannot be recovered
          from ``state``.
        - ``action`` ``[*B, A]``: float32 in the spec, float64 accepted. MuJoCo clamps limited controls.
        - ``variant`` ``[*B, 1]`` int64, with several scenes only: index of the sample's scene.
        - ``reward`` ``[*B, 1]`` float32; zero without ``reward``.
        - ``done``, ``terminated`` ``[*B, 1]``: true where the simulation became unstable. Add TorchRL's
          ``StepCounter`` for a time limit.

    An unstable simulation does not raise, so that one bad candidate cannot end a planner's search: the step keeps the
    last good state, sets ``terminated`` and gives ``unstable_reward``.

    ``reset()`` draws start states for the TensorDict's batch; ``reset(tensordict, set_state=True)`` starts from its
    ``physics``, or with several scenes from its ``variant`` alone. (``set_state=False`` ignores the entry; TorchRL 0.14
    warns if ``set_state`` is not given.)

    Collectors need a fixed number of environments: :func:`~torchrl_gn.envs.batched`.

    Args:
        scene: the scene, or variants of one (:func:`~torchrl_gn.scenes.sample_variants`). A batch cycles through them,
            or follows the TensorDict's ``variant``; ``env.scene`` is the first.
        reward: function ``(state, action, next_state, task) -> [*B, 1]``, for example from
            :func:`~torchrl_gn.rewards.make_reward`; ``task`` is the TensorDict's entry or None.
        start_states: ``[M, S]`` full MuJoCo states to start from, or a function
            ``(n, generator) -> [n, S]``. Default: the system's reset distribution.
        num_threads: threads of the simulation. Default: all cores.
        unstable_reward: reward of an unstable step.
        seed: seed of the start states. Default: drawn from torch's global generator.
        device: where TensorDicts movable; the simulation runs on the CPU.

    Raises:
        ValueError: start states have a wrong shape, the reward is of another scene, or ``unstable_reward`` is not
            finite; when stepping or resetting, ``action`` or ``physics`` is not finite or has a wrong shape.
        KeyError: when stepping, no ``physics`` or ``action``.

    Example:
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("pendulum")
        >>> env = SceneEnv(scene, make_reward("balance", scene), seed=0)
        >>> start = env.reset(TensorDict(batch_size=[5]))
        >>> env.rollout(20, tensordict=start, auto_reset=False)["next", "reward"].shape
        torch.Size([5, 20, 1])
    """

    _supports_set_state = True

    def __new__(cls, *args, **kwargs):
        return super().__new__(cls, *args, _batch_locked=False, **kwargs)

    def __init__(
        self,
        scene: Scene | Sequence[Scene],
        reward: RewardFunction | None = None,
        *,
        start_states: StartStates | None = None,
        num_threads: int | None = None,
        unstable_reward: float = -1e6,
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ):
        super().__init__(device=device)
        self.scenes = (scene,) if isinstance(scene, Scene) else tuple(scene)
        if not self.scenes:
            raise ValueError("SceneEnv needs at least one scene.")
        self.scene = self.scenes[0]
        self.reward = reward_of(reward, self, self.scene)
        self.num_threads = num_threads
        self.unstable_reward = finite_reward(unstable_reward)
        self.starts = StartSampler(self.scene, start_states, seed)
        self._simulator: Simulator | None = None
        set_specs(self, self.scene, physics=True, variants=len(self.scenes))

    @property
    def simulator(self) -> Simulator:
        """The batched simulation, started at first use."""
        if self._simulator is None:
            self._simulator = Simulator(self.scenes, num_threads=self.num_threads)
        return self._simulator

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_) -> TensorDict:
        if tensordict is None:
            tensordict = TensorDict(batch_size=self.batch_size)
        shape = tensordict.shape
        if len(self.scenes) > 1 and tensordict.get("variant", None) is None:
            in_turn = (torch.arange(shape.numel()) % len(self.scenes)).reshape(*shape, 1)
            tensordict = tensordict.copy().set("variant", in_turn)
        variant = self.variant_of(tensordict)
        if set_state and ("physics" in tensordict.keys() or variant is None):
            physics = read(tensordict, "physics", (self.scene.physics_size,), self)
            require_finite(physics, f"{self}: 'physics'")
            physics = physics.cpu().to(torch.float64, copy=True)
        else:
            physics = self.starts.draw(shape, tensordict.get("_reset", None), variant, simulator=self.simulator)
        entries = {"state": self.simulator.observe(physics, _each(variant)), "physics": physics}
        if variant is not None:
            entries["variant"] = variant
        return TensorDict(entries, batch_size=shape).to(self.device)

    def variant_of(self, tensordict: TensorDictBase) -> Tensor | None:
        """Index ``[*B, 1]`` of each sample's variant, on the CPU; None for a single scene."""
        if len(self.scenes) == 1:
            return None
        variant = read(tensordict, "variant", (1,), self).cpu()
        if variant.dtype != torch.int64 or not bool(((variant >= 0) & (variant < len(self.scenes))).all()):
            raise ValueError(f"{self}: 'variant' must be int64 in [0, {len(self.scenes)}), got {variant.flatten()[:5]}")
        return variant

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        physics = read(tensordict, "physics", (self.scene.physics_size,), self)
        action = read(tensordict, "action", (self.scene.num_actions,), self).detach()
        require_finite(physics, f"{self}: 'physics'")
        require_finite(action, f"{self}: 'action'")
        controls = action.unsqueeze(-2).cpu().to(torch.float64)
        variant = self.variant_of(tensordict)
        simulated = self.simulator.rollout(physics.detach().cpu(), controls, _each(variant))
        # Entry by entry: TensorDict.to costs as much as a small simulation.
        stable = simulated["stable"].to(self.device).unsqueeze(-1)
        state, next_state = simulated["state"].to(self.device).unbind(-3)
        next_state = torch.where(stable.unsqueeze(-1), next_state, state)
        next_physics = torch.where(stable, simulated["physics"][..., 1, :].to(self.device), physics.detach())
        reward = step_reward(self.reward, state, action, next_state, tensordict.get("task", None))
        entries = {
            "state": next_state,
            "physics": next_physics,
            "reward": torch.where(stable, reward, self.unstable_reward),
            "done": ~stable,
            "terminated": ~stable,
        }
        if variant is not None:
            entries["variant"] = variant.to(self.device, copy=True)
        return TensorDict(entries, batch_size=tensordict.shape, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self.starts.seed(seed)

    def __repr__(self) -> str:
        return f"SceneEnv({self.scene.name!r})"

    def __getstate__(self) -> dict:
        # Copies and worker processes start their own threads and MuJoCo data.
        return {**super().__getstate__(), "_simulator": None}


def _each(variant: Tensor | None) -> Tensor | None:
    return None if variant is None else variant.squeeze(-1)
