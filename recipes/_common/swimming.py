"""Trajectories of a swimmer that swims on purpose: by a gait, or by a learned policy."""

from __future__ import annotations

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_gn.data import Simulator, UnstableSimulationError, sample_start_states
from torchrl_gn.envs import SceneEnv
from torchrl_gn.policies import Agent, SwimmerObservation
from torchrl_gn.scenes import Scene

LOW, HIGH = np.array([0.1, 0.2, -np.pi]), np.array([1.0, 2.0, np.pi])  # of a wave: height, Hz, lag from joint to joint


def waves(scene: Scene, gaits: np.ndarray, steps: int, phase: np.ndarray) -> np.ndarray:
    """Return controls ``[n, T, A]`` of gaits ``[n, 3]`` (height as share of the bounds, Hz, lag) and phases ``[n]``."""
    time = np.arange(steps) * scene.timestep
    height, frequency, lag = (column[:, None, None] for column in gaits.T)
    angle = 2 * np.pi * frequency * time[None, :, None] - lag * np.arange(scene.num_actions) + phase[:, None, None]
    middle, half = (scene.action_high + scene.action_low) / 2, (scene.action_high - scene.action_low) / 2
    return middle + half * height * np.sin(angle)


def distance(states: torch.Tensor) -> np.ndarray:
    """Return the distance ``[n]`` in metres that the mean position of the bodies covers."""
    middle = states[:, :, 1:, :3].mean(2)
    return (middle[:, -1] - middle[:, 0]).norm(dim=-1).numpy()


def find_gait(scene: Scene, cfg: DictConfig, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Find the gait ``[3]`` that swims farthest, by the cross-entropy method; return it and its distance in metres."""
    simulator, center, std = Simulator(scene), (LOW + HIGH) / 2, (HIGH - LOW) / 2
    for _ in tqdm(range(cfg.search.generations), desc="looking for a gait", leave=False):
        gaits = np.clip(rng.normal(center, std, (cfg.search.population, 3)), LOW, HIGH)
        # Several starts for every gait, so that none wins by luck.
        every = np.repeat(gaits, cfg.search.starts, axis=0)
        starts = np.tile(sample_start_states(scene, cfg.search.starts, rng), (len(gaits), 1))
        actions = waves(scene, every, cfg.search.steps, np.zeros(len(every)))
        far = distance(simulator.rollout(starts, actions)["state"]).reshape(len(gaits), -1).mean(1)
        elite = gaits[np.argsort(-far)[: max(2, len(gaits) // 8)]]
        center, std = elite.mean(0), elite.std(0) + 1e-3
    return center, float(np.sort(far)[::-1][: len(elite)].mean())


def swim(scene: Scene, gait: np.ndarray, count: int, steps: int, rng: np.random.Generator) -> TensorDict:
    """Simulate ``count`` trajectories of variations of a gait, after a run-up."""
    gaits = np.clip(gait * rng.uniform(0.8, 1.2, (count, 3)), LOW, HIGH)
    gaits[:, 2] *= rng.choice([-1, 1], count)  # in either direction
    going = 100
    actions = waves(scene, gaits, going + steps, rng.uniform(0, 2 * np.pi, count))
    half = (scene.action_high - scene.action_low) / 2
    actions = np.clip(actions + 0.1 * half * rng.normal(size=actions.shape), scene.action_low, scene.action_high)
    found = Simulator(scene).rollout(sample_start_states(scene, count, rng), actions)
    if unstable := int((~found["stable"]).sum()):
        raise UnstableSimulationError(f"{unstable} of {count} swimmers became unstable; try another seed.")
    action = torch.from_numpy(actions[:, going:])
    return TensorDict({"state": found["state"][:, going:].clone(), "action": action}, [count])


def swim_by_policy(scene: Scene, agent: Agent, hold: int, count: int, steps: int, seed: int) -> TensorDict:
    """Simulate ``count`` trajectories under a learned policy, each to its own target, after a run-up.

    Each action is held for ``hold`` control steps, as in the policy's training.
    """
    env, going = SceneEnv(scene, seed=seed), 100
    policy = TensorDictSequential([SwimmerObservation(scene), agent.policy])
    generator = torch.Generator().manual_seed(seed)
    now = env.reset(TensorDict(batch_size=[count]))
    targets = 4 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 2  # as in the suite, metres
    now["target"] = torch.cat((targets, torch.full((count, 1), 0.05, dtype=torch.float64)), dim=1)
    states, actions = [], []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in tqdm(range(going + steps + 1), desc="swimming", leave=False):
            states.append(now["state"])
            if step % hold == 0:
                now = policy(now)
            actions.append(now["action"].double())
            now.update(env.step(now)["next"].select("state", "physics", "terminated"))
            if unstable := int(now["terminated"].sum()):
                raise UnstableSimulationError(f"{unstable} of {count} swimmers became unstable; try another seed.")
    kept = {"state": torch.stack(states[going:], 1), "action": torch.stack(actions[going:-1], 1)}
    return TensorDict(kept, [count])
