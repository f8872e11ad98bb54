"""Measure the run time of policy learning: environment steps, and updates with the reference and the fast model.

    python recipes/benchmarks/svg.py [repeats=30] [batch_size=256] [horizons=[0,1,3]]

Times one update (sampling, losses of policy, value and model, gradients, optimiser) of SVG(N), in turn and several
times: with a graph network evaluated by message passing (reference), folded, or folded and compiled (as recipes/svg.py
uses it), and with an MLP in its place. Also times a step of the environments. No figure of the paper.

Writes config.yaml, metrics.json and the table as table.md to its run folder.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import ValueEstimators

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import as_list, clean_exit, finish_run, open_run, with_help
from _timing import time_in_turn
from torchrl_gn.atomic import atomic_path
from torchrl_gn.envs import observation_env
from torchrl_gn.objectives import ObservationModelLoss, SVGLoss
from torchrl_gn.policies import Agent
from torchrl_gn.rewards import TargetDistance
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training import OffPolicyTrainer, make_agent_optimizer


def make_update(
    cfg: DictConfig, graph: ObservationGraph, env: EnvBase, data: TensorDictBase, horizon: int, way: str
) -> Callable[[], dict[str, float]]:
    """Return an agent's update; ``way`` is ``reference``, ``folded``, ``compiled``, ``mlp`` or ``mlp compiled``."""
    kind = None if horizon == 0 else ("mlp" if "mlp" in way else "gn")
    options = {**cfg.model_options, "plain": way == "reference"}
    agent = Agent(graph, hidden=cfg.hidden, model=kind, model_options=options)
    reward = TargetDistance(graph) if horizon else None
    loss = SVGLoss(agent.policy, agent.value, agent.model, reward, steps=horizon, delay_actor=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.99)
    losses = [loss] if agent.model is None else [loss, ObservationModelLoss(agent.model)]
    optimizer = make_agent_optimizer(losses, policy_lr=1e-4, value_lr=1e-4, model_lr=1e-4)
    options = {"frames": data.numel(), "batch_size": cfg.batch_size, "compile": "compiled" in way}
    trainer = OffPolicyTrainer(agent, losses, env, agent.policy, lambda: 0.0, optimizer, **options)
    trainer.remember(data)
    return trainer.update


@with_help
@hydra.main(version_base="1.3", config_path="config", config_name="svg")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    run, tracker = open_run(cfg, "benchmarks/svg")
    graph = ObservationGraph.of_task("swimmer", cfg.task)
    env = observation_env(graph, "swimmer", cfg.task, num_envs=cfg.num_envs, timestep=0.02, seed=cfg.seed)
    data = env.rollout(-(-4 * cfg.batch_size // cfg.num_envs), break_when_any_done=False)
    policy, start = Agent(graph, hidden=cfg.hidden).policy, env.reset()
    experience = torch.no_grad()(lambda: env.step(policy(start.copy())))
    ways: dict[str, Callable] = {f"{cfg.num_envs} environment steps": experience}
    for horizon in as_list(cfg.horizons):
        methods = ("reference", "folded", "compiled", "mlp", "mlp compiled") if horizon else ("reference", "compiled")
        for way in methods if cfg.compile else (way for way in methods if "compiled" not in way):
            ways[f"SVG({horizon}), {way}"] = make_update(cfg, graph, env, data, horizon, way)

    seconds = time_in_turn(ways, cfg.repeats, warm_up=3)
    medians = {name: statistics.median(found) for name, found in seconds.items()}
    lines = ["| | ms (lower is better) | a second | times as fast as the reference |", "|---|---|---|---|"]
    for name, median in medians.items():
        reference = medians.get(f"{name.split(',')[0]}, reference")
        faster = f"{reference / median:.2f}x" if reference else ""
        lines.append(f"| {name} | {1e3 * median:.2f} | {1 / median:.0f} | {faster} |")
    with atomic_path(run.file("table.md")) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    finish_run(cfg, run, tracker, {f"{name}/ms": 1e3 * median for name, median in medians.items()})


if __name__ == "__main__":
    main()
