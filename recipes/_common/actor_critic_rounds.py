"""Rounds of a short-horizon actor-critic: what learns in them, on one scene or several, and what they leave."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDict

from _common.actor_critic import WINDOW, ActorCriticOptimizer, TargetSquares, play, played_windows, windows
from _common.tensor_files import load_tensors
from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import (
    BoundEnsemble,
    BoundPredictor,
    Canonicalizer,
    Ensemble,
    ForwardModel,
    SpecializedPredictor,
    SplitEnsemble,
    specialize,
)
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.planners import BoundedPolicy, GraphStatePolicy, StatePolicy, StateReward, StateValue, task_invariances
from torchrl_gn.rewards import Reward
from torchrl_gn.scenes import Scene
from torchrl_gn.training import fit, load_pretrained, plain_config, save_checkpoint
from torchrl_gn.training.tensor_files import write_tensors
from torchrl_gn.training.workers import Workers

JUDGED_STEPS = 500  # control steps of an episode
_SCALED_BY = 5  # last rounds whose rewards the value is scaled by


class Round:
    """What a round leaves in its folder; finished once the last file is written, its numbers."""

    def __init__(self, folder: Path, index: int) -> None:
        self.path = folder / "rounds" / f"{index:03}"
        self.policy, self.numbers = self.path / "policy.safetensors", self.path / "numbers.json"

    @property
    def finished(self) -> bool:
        return self.numbers.exists()

    def of(self, what: str, task: Task) -> Path:
        """The file of a task's ``model``, ``value``, learned ``reward`` or ``played`` trajectories."""
        return self.path / task.folder / f"{what}.safetensors"


def new_model(scene: Scene, members: int, options: dict[str, Any]) -> ForwardModel | Ensemble:
    """A model with fresh weights, or an ensemble."""
    if members == 1:
        return ForwardModel.for_scene(scene, **options)
    return Ensemble.for_scene(scene, count=members, **options)


class Task:
    """A scene with its reward, and the model and value that learn for it, with their data on one device.

    Args:
        folder: of its files in a run and in a round.
        modelled: the scene with the control step of the model, of which an action is as many as fill it. Default: its.
        invariances: of the task; default: those of scene and reward.
    """

    model: BoundPredictor | BoundEnsemble
    value: StateValue
    loss: SHACLoss

    def __init__(
        self,
        cfg: DictConfig,
        scene: Scene,
        reward: Reward,
        judge: Reward,
        folder: str,
        *,
        modelled: Scene | None = None,
        invariances: Canonicalizer | None = None,
    ) -> None:
        self.targeted = reward.target_shape is not None
        if self.targeted and "suite" not in scene.origin:
            raise ValueError(f"A policy of states does not know the target of {reward}.")
        self.cfg, self.scene, self.reward, self.judge, self.folder = cfg, scene, reward, judge, folder
        self.modelled = modelled or scene
        self.model_steps = round(scene.timestep / self.modelled.timestep)  # under an action
        self.device = Workers().device(cfg.device)
        self.squares = TargetSquares(scene, cfg.target_squares) if cfg.target_squares else None
        self.invariances = invariances or task_invariances(scene, reward)
        self.data: list[TensorDict] = []
        self.judged_starts = None if self.squares is None else self.squares.start_states
        if (suite_seed := cfg.evaluate.suite_seed) is not None:
            if self.squares is None:
                raise ValueError("evaluate.suite_seed= is for a target: give target_squares= too.")
            states = self.squares.suite_states(cfg.evaluate.episodes, suite_seed)
            self.judged_starts = lambda n, _: states[:n]

    def collect(self, done: list[Round]) -> None:
        """Trajectories of random control, and those that finished rounds played."""
        self.data = [self.play_at_random().to(self.device)]
        for each in done:
            played = load_tensors(each.of("played", self))
            self.data.append(TensorDict(played, [len(played["action"])]).to(self.device))

    def begin(self, policy: BoundedPolicy, begun: Round | None) -> None:
        """Make model, value and loss, or read them from the last round."""
        cfg, config = self.cfg, plain_config(self.cfg)
        if begun is None:
            model = new_model(self.modelled, cfg.members, config["model"])
            options = {"discount": cfg.discount, "hidden": cfg.hidden, "target": self.targeted}
            self.value = StateValue(self.scene, canonicalizer=self.invariances, **options)
        else:
            model = load_pretrained(begun.of("model", self)).trained
            self.value = load_pretrained(begun.of("value", self)).value
        self.trained = cast("ForwardModel | Ensemble", model).to(self.device)
        self.model = self.trained.bind(self.modelled)
        imagined = ModelEnv(self.model, self.reward)  # until the model has learned: learn_model() takes a snapshot
        options = {"steps": cfg.horizon, "lmbda": cfg.lmbda, "pessimism": cfg.pessimism}
        options |= {"action_repeat": self.model_steps, "outlier": cfg.outlier}
        self.loss = SHACLoss(policy, self.value, imagined, **options).to(self.device)

    @property
    def newest(self) -> TensorDict:
        """The last trajectories. A round whose episodes all became unstable left none."""
        return next(played for played in reversed(self.data) if len(played))

    def learn_model(self, index: int) -> None:
        """Train the model, and what else is learned of the scene, on all data; tell normalisers of the newest."""
        cfg, first = self.cfg, index == 0
        steps, lr = (cfg.first.steps, None) if first else (cfg.model_steps, cfg.model_lr)
        data = cast(TensorDict, torch.cat(cast(Any, self.data)))
        # All samples count alike, as when the results were measured.
        for number, member in enumerate(self.members):
            seed = cfg.seed + index + 1_000_000 * number
            fit(member, data, steps=steps, lr=lr, seed=seed, size_floor=None)
        self.learn_reward(data, index)
        self._take_snapshot()
        seen = self.newest["state"].flatten(0, 1)
        last = cast(TensorDict, torch.cat(cast(Any, self.data[-_SCALED_BY:])))
        with torch.no_grad():
            reward = cast(Reward, self.loss.env.reward)  # on the device
            targets = last["target"].unsqueeze(1).expand(*last["action"].shape[:2], 3) if self.targeted else None
            rewards = self.model_steps * reward(last["state"][:, :-1], last["action"], last["state"][:, 1:], targets)
        target = self.newest["target"].repeat_interleave(WINDOW + 1, 0) if self.targeted else None
        seen = seen if self.squares is None else self.squares.move(seen)
        self.loss.fit_normalizers(seen, rewards.flatten(0, 1), target)

    def learn_reward(self, data: TensorDict, index: int) -> None:
        """Nothing: the reward is known."""

    @property
    def members(self) -> list[BoundPredictor]:
        """The model, or the members of the ensemble."""
        return cast(Any, self.model.members) if isinstance(self.model, BoundEnsemble) else [self.model]

    def _take_snapshot(self) -> None:
        """Imagine with the model as it is now."""
        env = self.loss.env
        before = env.world_model.members if isinstance(env.world_model, SplitEnsemble) else [env.world_model]
        if isinstance(before[0], SpecializedPredictor):
            for snapshot, member in zip(cast(Any, before), self.members, strict=True):
                snapshot.refresh(member)
        else:
            model = specialize(self.model)
            env.world_model = cast(Any, model.split() if isinstance(model, BoundEnsemble) else model)

    def starts(self) -> Callable[[int], TensorDict]:
        """What draws states ``[size]`` to imagine from, half of the newest episodes, half of all."""
        found = []
        for data in self.data, [self.newest]:
            states = torch.cat([part["state"][:, :-1].flatten(0, 1) for part in data])
            entries = {"state": states}
            if self.targeted:
                entries["target"] = torch.cat([part["target"].repeat_interleave(WINDOW, 0) for part in data])
            found.append(TensorDict(entries, [len(states)]))

        def draw(size: int) -> TensorDict:
            counts = size - size // 2, size // 2
            draws = zip(found, counts, strict=True)
            parts = [of[torch.randint(len(of), (count,), device=self.device)] for of, count in draws]
            if self.squares is not None:
                parts[0]["state"] = self.squares.move(parts[0]["state"])
            return cast(TensorDict, torch.cat(cast(Any, parts)))

        return draw

    def play_at_random(self) -> TensorDict:
        """Trajectories of random control."""
        cfg = self.cfg
        first = collect_trajectories(self.scene, cfg.first.trajectories, steps=cfg.first.length, seed=cfg.seed)
        return windows(first["state"], first["action"])

    def play(self, policy: BoundedPolicy, seed: int) -> TensorDict:
        """Trajectories of a round's episodes with exploration."""
        cfg, starts = self.cfg, None if self.squares is None else self.squares.start_states
        env = SceneEnv(self.scene, self.reward, seed=seed, start_states=starts)
        return played_windows(play(env, policy, episodes=cfg.episodes, steps=cfg.steps, explore=True))

    def judged(self, policy: BoundedPolicy) -> TensorDict:
        """Episodes ``[M, T]`` without exploration, from the same starts every round; rewards of a frame."""
        env = SceneEnv(self.scene, self.judge, seed=10_000, start_states=self.judged_starts)
        sizes = {"episodes": self.cfg.evaluate.episodes, "steps": self.cfg.evaluate.steps or JUDGED_STEPS}
        return play(env, policy, **sizes, explore=False)

    @property
    def networks(self) -> dict[str, ForwardModel | Ensemble | StateValue | StateReward]:
        """What learns for the task beside the policy, by what :meth:`Round.of` calls it."""
        return {"value": self.value, "model": self.trained}

    def save(self, of: Round) -> None:
        """Write the networks."""
        for what, network in self.networks.items():
            scene = self.scene if what == "value" else self.modelled
            save_checkpoint(of.of(what, self), network, scene=scene, config=plain_config(self.cfg))

    def add(self, played: TensorDict, of: Round) -> None:
        """Keep a round's trajectories, also in its folder."""
        self.data.append(played.to(self.device))
        write_tensors(of.of("played", self), dict(played.items()))


class ActorCritic:
    """A policy and its tasks, and how they learn from one round to the next."""

    def __init__(self, cfg: DictConfig, tasks: list[Task], begun: Round | None) -> None:
        self.cfg, self.tasks, kept = cfg, tasks, None
        if begun is None:
            self.policy = self._new_policy()
        else:
            kept = load_pretrained(begun.policy)
            self.policy = kept.policy
        self.policy.to(tasks[0].device)
        for task in tasks:
            task.begin(self.policy.for_scene(task.scene), begun)
        rates = {name: cfg[name] for name in ("policy_lr", "value_lr", "alpha_lr")}
        self.optimizer = ActorCriticOptimizer([task.loss for task in tasks], **rates)
        if kept is not None:
            kept.resume(self.optimizer.load_state_dict)

    def _new_policy(self) -> BoundedPolicy:
        first = self.tasks[0]
        if self.cfg.policy == "graph":
            if any(task.targeted for task in self.tasks):
                raise ValueError("policy=graph does not read the target that episodes of this task have: policy=mlp.")
            return GraphStatePolicy(first.scene, canonicalizer=first.invariances, **plain_config(self.cfg)["graph"])
        if self.cfg.policy != "mlp" or len(self.tasks) > 1:
            wanted = "mlp or graph" if len(self.tasks) == 1 else "graph to learn on several systems"
            raise ValueError(f"policy={self.cfg.policy} must be {wanted}.")
        options = {"hidden": self.cfg.hidden, "canonicalizer": first.invariances, "target": first.targeted}
        return StatePolicy(first.scene, **options)

    def learn(self, index: int) -> dict[str, float]:
        """Train the models, then policy and values in them."""
        for task in self.tasks:
            task.learn_model(index)
        batches = [task.starts() for task in self.tasks]
        sizes = {"updates": self.cfg.updates, "batch_size": self.cfg.batch_size // self.cfg.members}
        return self.optimizer.learn(batches, **sizes, desc=f"policy, round {index}")

    def playing(self) -> BoundedPolicy:
        """A copy of the policy on the processor, where MuJoCo is."""
        return copy.deepcopy(self.policy).cpu()

    def averaged(self, folder: Path, index: int) -> BoundedPolicy:
        """:meth:`playing` with mean weights of the last rounds, a quarter of all or ``average``: steadier than one."""
        policy = self.playing()
        first = index + 1 - min(self.cfg.average, 1 + index // 4)
        before = [load_pretrained(Round(folder, each).policy).policy for each in range(first, index)]
        with torch.no_grad():
            for mean, *weights in zip(policy.parameters(), *(each.parameters() for each in before), strict=True):
                mean.copy_(torch.stack([mean, *weights]).mean(0))
        return policy

    def save(self, of: Round) -> None:
        """Write the networks of a round, with what the next needs."""
        of.path.mkdir(parents=True, exist_ok=True)
        for task in self.tasks:
            of.of("model", task).parent.mkdir(exist_ok=True)
            task.save(of)
        self.save_policy(of.policy, self.policy, training=self.optimizer.state_dict())

    def save_policy(self, path: Path, policy: BoundedPolicy, **options: Any) -> None:
        """Write a policy of these tasks."""
        scenes = [task.scene for task in self.tasks]
        save_checkpoint(path, policy, scene=scenes, config=plain_config(self.cfg), **options)
