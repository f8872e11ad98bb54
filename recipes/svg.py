"""Learn a policy by stochastic value gradients (SVG) through a forward model that is learned at the same time.

    python recipes/svg.py [horizon=1] [task=swimmer6] [key=value ...]

Reproduces the agents of the paper's Figure "Learning curves for Swimmer6 SVG agents": SVG(1) differentiates through a
graph network that predicts observations, SVG(0) (`horizon=0`) through the value alone. Policy, value and model start
from fresh weights and learn from the same replay buffer. recipes/learning_curves.py draws all agents' curves over
several seeds in one figure. The same `run_dir` resumes a stopped run. Results: docs/results/svg.md.

Writes config.yaml, metrics.json, the learning curve (curve.json and curve.png) and a checkpoint. All options:
recipes/config/svg.yaml.
"""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial

import hydra
import torch
from omegaconf import DictConfig
from torchrl.objectives import LossModule, ValueEstimators
from tqdm import tqdm

from _common import clean_exit, open_log, resumed_checkpoint, with_help
from _common.progress import learning, report_learning
from torchrl_gn.envs import observation_env
from torchrl_gn.objectives import ObservationModelLoss, SVGLoss
from torchrl_gn.policies import Agent
from torchrl_gn.rewards import TargetDistance
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training import (
    OffPolicyTrainer,
    RayCluster,
    RunFolder,
    make_agent_optimizer,
    mean_return,
    plain_config,
)

# Options that may change when a run resumes.
MAY_CHANGE = (
    "trainer.frames",
    "trainer.compile",
    "threads",
    "logger",
    "run_dir",
    "checkpoint_seconds",
    "ray",
    "collectors",
    "evaluate_on",
)


def make_losses(cfg: DictConfig, agent: Agent) -> list[LossModule]:
    """Return the loss of SVG(N) and, with a model, the loss of model and reward."""
    known = cfg.task.reward == "known"
    reward = TargetDistance(agent.graph) if known and cfg.horizon else agent.reward
    loss = SVGLoss(agent.policy, agent.value, agent.model, reward, steps=cfg.horizon, delay_actor=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=cfg.gamma)
    return [loss] if agent.model is None else [loss, ObservationModelLoss(agent.model, agent.reward)]


@with_help
@hydra.main(version_base=None, config_path="config", config_name="svg")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    if cfg.ray is None and cfg.collectors != 1:
        raise ValueError(f"collectors={cfg.collectors} needs a Ray cluster; pass ray=local, or ray=auto to join one.")
    run = RunFolder(cfg.run_dir, "svg")
    if (per_batch := cfg.trainer.frames_per_batch) % (together := cfg.collectors * cfg.num_envs):
        raise ValueError(
            f"trainer.frames_per_batch={per_batch} must be a multiple of {together}: num_envs times collectors."
        )
    resumed = resumed_checkpoint(cfg, run, MAY_CHANGE)
    graph = ObservationGraph.of_task(cfg.task.domain, cfg.task.name, plain_config(cfg)["task"]["graph"])
    if cfg.evaluate_on and cfg.agent.policy != "graph":
        raise ValueError("Only a graph network drives other bodies; evaluate_on needs agent.policy=graph.")
    more = plain_config(cfg.agent)
    if cfg.horizon == 0:
        more["model"] = None
    learned = cfg.task.reward == "learned" and cfg.horizon > 0
    agent = resumed.agent if resumed else Agent(graph, learned_reward=learned, **more)
    tracker = open_log(cfg, run, label=f"svg{cfg.horizon}-{cfg.task.name}")

    task = {"timestep": cfg.task.timestep, "steps": cfg.task.steps, "seed": 0}  # an evaluation sets its own seed
    others = {}  # made before learning, so that a task that does not fit fails at once
    for name in cfg.evaluate_on:
        other = ObservationGraph.of_task(cfg.task.domain, name)
        agent.policy_for(other)
        others[name] = other, observation_env(other, cfg.task.domain, name, num_envs=cfg.evaluate_episodes, **task)
    make_env = partial(observation_env, graph, cfg.task.domain, cfg.task.name, **task)
    evaluation = make_env(num_envs=cfg.evaluate_episodes)
    losses = make_losses(cfg, agent)
    makers = [partial(make_env, num_envs=cfg.num_envs, seed=cfg.seed + 1000 * index) for index in range(cfg.collectors)]
    with nullcontext() if cfg.ray is None else RayCluster(cfg.ray):
        trainer = OffPolicyTrainer(
            agent,
            losses,
            makers[0]() if cfg.ray is None else makers,
            agent.policy,
            lambda: mean_return(evaluation, agent.policy, cfg.task.steps, seed=10_000),
            make_agent_optimizer(losses, policy_lr=cfg.policy_lr, value_lr=cfg.value_lr, model_lr=cfg.model_lr),
            seed=cfg.seed,
            **plain_config(cfg.trainer),
        )
        with learning(trainer, run.checkpoint, resumed, tracker, config=plain_config(cfg)) as log:
            # In each turn the policy acts for trainer.frames_per_batch steps, which the replay buffer keeps, and the
            # networks take trainer.updates_per_frame gradient steps for each on transitions from the buffer. Every
            # trainer.evaluate_frames steps, the policy plays the evaluation's episodes.
            for progress in trainer.run():
                log(progress)
    returns = {}
    for name, (other, env) in tqdm(others.items(), desc="other bodies", leave=False, disable=not others):
        returns[f"return/{name}"] = mean_return(env, agent.policy_for(other), cfg.task.steps, seed=10_000)
    report_learning(trainer, run, tracker, label=f"SVG({cfg.horizon})", seed=cfg.seed, more=returns)


if __name__ == "__main__":
    main()
