"""Tasks on a Ray cluster of this machine return the same results as in this process."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from torchrl.objectives import ValueEstimators

from torchrl_gn.data import create_dataset
from torchrl_gn.envs import observation_env
from torchrl_gn.objectives import SVGLoss
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph, load_scene
from torchrl_gn.training import OffPolicyTrainer, RayCluster

pytest.importorskip("ray")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster():
    with RayCluster("local") as cluster:
        yield cluster


def test_results_come_in_order(cluster):
    assert list(cluster.imap(lambda x: x * x, iter(range(9)))) == [x * x for x in range(9)]
    assert cluster.submit(divmod, 7, 3).result() == (2, 1)


def test_a_data_set_is_the_same(cluster, tmp_path):
    scene = load_scene("pendulum")
    sizes: dict[str, Any] = {"train": 600, "validation": 1, "test": 1, "steps": 3}
    spread = create_dataset(tmp_path / "spread", scene, **sizes, map_chunks=cluster.imap, num_threads=1)
    here = create_dataset(tmp_path / "here", scene, **sizes)
    assert spread.manifest["chunks"] == here.manifest["chunks"]  # checksums and all


def test_collectors_act_by_the_last_policy(cluster):
    graph = ObservationGraph.swimmer(3)
    agent = Agent(graph, hidden=(4,), model=None)
    loss = SVGLoss(agent.policy, agent.value, None, None, steps=0, delay_actor=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    trainer = OffPolicyTrainer(
        agent,
        [loss],
        [partial(observation_env, graph, "swimmer", "swimmer3", steps=10, num_envs=2, seed=seed) for seed in range(2)],
        agent.policy,
        lambda: 0.0,
        torch.optim.Adam(loss.parameters(), lr=0.0),
        frames=160,
        frames_per_batch=40,
        random_frames=40,
        batch_size=8,
    )
    for progress in trainer.run():
        if progress.frames == 40:
            with torch.no_grad():  # from the next update on it always wants the same
                for weight in agent.policy.parameters():
                    weight.zero_()
                *_, last = (w for w in agent.policy.parameters() if w.shape == (2 * graph.num_actions,))
                last[: graph.num_actions] = 5.0
                last[graph.num_actions :] = -10.0
    assert progress.frames == 160
    actions = trainer.buffer[:]["action"]
    assert actions[:40].std() > 0.3
    assert actions[-40:].min() > 0.5  # the tanh of 1, but for some noise
    assert len(trainer.buffer[:]["observation"].unique(dim=0)) == 160  # each collector has a seed of its own
