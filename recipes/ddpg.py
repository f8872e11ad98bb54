"""Learn a policy by DDPG with TorchRL's loss: the model-free baseline, and a source of policy trajectories.

    python recipes/ddpg.py [task=swimmer6] [key=value ...]

Reproduces the paper's agent (SM "DDPG"), with the environments, networks, replay buffer and updates of recipes/svg.py,
so that only the losses differ. recipes/learning_curves.py draws curves over several seeds. The same `run_dir` resumes a
stopped run. Results: docs/results/svg.md.

Writes config.yaml, metrics.json, the learning curve (curve.json and curve.png) and a checkpoint. All options:
recipes/config/ddpg.yaml.
"""

from __future__ import annotations

from functools import partial

import hydra
import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, ValueEstimators

from _common import clean_exit, open_log, resumed_checkpoint, with_help
from _common.progress import learning, report_learning
from torchrl_gn.envs import observation_env
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training import (
    OffPolicyTrainer,
    RunFolder,
    make_agent_optimizer,
    mean_return,
    plain_config,
)

# Options that may change when a run resumes.
MAY_CHANGE = ("trainer.frames", "trainer.compile", "threads", "logger", "run_dir", "checkpoint_seconds")


@with_help
@hydra.main(version_base=None, config_path="config", config_name="ddpg")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    run = RunFolder(cfg.run_dir, "ddpg")
    resumed = resumed_checkpoint(cfg, run, MAY_CHANGE)
    graph = ObservationGraph.of_task(cfg.task.domain, cfg.task.name, plain_config(cfg)["task"]["graph"])
    agent = resumed.agent if resumed else Agent(graph, stochastic=False, hidden=cfg.hidden)
    tracker = open_log(cfg, run, label=f"ddpg-{cfg.task.name}")

    task = {"timestep": cfg.task.timestep, "steps": cfg.task.steps}
    make_env = partial(observation_env, graph, cfg.task.domain, cfg.task.name, **task)
    evaluation = make_env(num_envs=cfg.evaluate_episodes)
    loss = DDPGLoss(agent.policy, agent.value, delay_actor=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=cfg.gamma)
    env = make_env(num_envs=cfg.num_envs, seed=cfg.seed)
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=cfg.noise, sigma_end=cfg.noise)
    trainer = OffPolicyTrainer(
        agent,
        [loss],
        env,
        TensorDictSequential([agent.policy, noise]),
        lambda: mean_return(evaluation, agent.policy, cfg.task.steps, seed=10_000),
        make_agent_optimizer([loss], policy_lr=cfg.policy_lr, value_lr=cfg.value_lr),
        seed=cfg.seed,
        **plain_config(cfg.trainer),
    )
    with learning(trainer, run.checkpoint, resumed, tracker, config=plain_config(cfg)) as log:
        # In each turn the policy acts with noise for trainer.frames_per_batch steps, which the replay buffer keeps, and
        # the networks take trainer.updates_per_frame gradient steps for each on transitions from the buffer. Every
        # trainer.evaluate_frames steps, the policy plays the evaluation's episodes.
        for progress in trainer.run():
            log(progress)
    report_learning(trainer, run, tracker, label="DDPG", seed=cfg.seed)


if __name__ == "__main__":
    main()
