"""Trajectories under a policy and within bounds."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor, TanhNormal

from torchrl_gn.data import Simulator, UnstableSimulationError, collect_trajectories, create_dataset, trajectory_buffer
from torchrl_gn.envs import SceneEnv
from torchrl_gn.scenes import Scene, load_scene, sample_variants

from .. import zoo


def _actor(scene: Scene, dtype: torch.dtype = torch.float32) -> ProbabilisticTensorDictSequential:
    torch.manual_seed(0)
    linear = nn.Linear(13 * scene.num_nodes, 2 * scene.num_actions)
    layers = nn.Sequential(nn.Flatten(-2), linear, NormalParamExtractor())
    modules = (
        TensorDictModule(layers.to(dtype), ["state"], ["loc", "scale"]),
        ProbabilisticTensorDictModule(["loc", "scale"], ["action"], distribution_class=TanhNormal),
    )
    return ProbabilisticTensorDictSequential(*cast(Any, modules))


def test_a_torchrl_policy_explores_and_repeats(pendulum: Scene) -> None:
    policy = _actor(pendulum)
    data = collect_trajectories(pendulum, 6, 5, seed=3, policy=policy)
    assert data["state"].shape == (6, 6, 2, 13) and data["action"].shape == (6, 5, 1)
    assert data["physics"].shape == (6, 6, pendulum.physics_size) and len(data.keys()) == 3
    assert all(data[key].dtype == torch.float64 for key in data.keys())
    assert torch.equal(data["physics"][:, 0], collect_trajectories(pendulum, 6, 5, seed=3)["physics"][:, 0])
    before = torch.random.get_rng_state()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        again = collect_trajectories(pendulum, 6, 5, seed=3, policy=policy)
    assert torch.equal(again["action"], data["action"])
    assert torch.equal(torch.random.get_rng_state(), before)
    with torch.no_grad():
        mean = policy[0](TensorDict({"state": data["state"][:, :-1].float()}, [6, 5]))["loc"].tanh()
    assert 0.05 < (data["action"] - mean).abs().mean() < 1.5
    replayed = Simulator(pendulum).rollout(data["physics"][:, 0], data["action"])
    assert torch.equal(replayed["state"], data["state"]) and torch.equal(replayed["physics"], data["physics"])
    assert trajectory_buffer(data, batch_size=4, seed=0).sample()["next", "state"].shape == (4, 2, 13)


def test_as_the_environment_does(swimmer: Scene) -> None:
    """A policy of float64, whose actions are clamped."""

    def policy(entries):
        return entries.set("action", 1 + 3 * entries["state"][:, 1:6, 12] - 0.2 * entries["physics"][:, :1])

    data = collect_trajectories(swimmer, 4, 6, seed=1, policy=policy)
    env, entries = SceneEnv(swimmer), None
    start = TensorDict({"physics": data["physics"][:, 0]}, [4])
    entries = env.reset(start, set_state=True)
    for step in range(6):
        entries = env.step(policy(entries))["next"]
        assert torch.equal(entries["state"], data["state"][:, step + 1])
    assert data["action"].abs().max() == 1


def test_functions_and_hidden_states(pendulum: Scene) -> None:
    """A tensor is an action; entries written under ``next`` are read in the next step."""
    seen = []

    def policy(entries):
        seen.append((entries["is_init"].all().item(), int(entries.get("count", torch.zeros(4, 1))[0])))
        count = entries.get("count", torch.zeros(4, 1)) + 1
        return TensorDict({"action": torch.zeros(4, 1), "next": TensorDict({"count": count}, [4])}, [4])

    collect_trajectories(pendulum, 4, 3, policy=policy)
    assert seen == [(True, 0), (False, 1), (False, 2)]
    still = collect_trajectories(pendulum, 4, 3, policy=lambda entries: torch.zeros(4, 1))
    assert not still["action"].any()
    for bad, message in (
        (lambda entries: entries, "must write 'action' .* it gave .*'is_init', 'physics', 'state'"),
        (lambda entries: torch.zeros(4, 2), r"action must be \[4, 1\], got \[4, 2\]"),
        (lambda entries: torch.full((4, 1), torch.nan), "action at step 0 has nan at index"),
    ):
        with pytest.raises(ValueError, match=message):
            collect_trajectories(pendulum, 4, 3, policy=bad)


def test_variants_are_told_to_the_policy() -> None:
    scenes = sample_variants("pendulum", 3, rng=0)
    seen = []

    def policy(entries):
        seen.append(entries["variant"].flatten().tolist())
        return 0.1 * entries["variant"]

    data = collect_trajectories(scenes, 5, 4, policy=policy)
    assert seen == [[0, 1, 2, 0, 1]] * 4
    torch.testing.assert_close(data["action"][:, 0, 0], 0.1 * torch.tensor([0, 1, 2, 0, 1.0]).double())
    assert data["parameters"].shape == (5,)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_unstable_servos_are_told_of_the_integrator(integrator) -> None:
    wheel = "<body><joint name='a'/><geom type='cylinder' size='.08 .02' mass='.3'/></body>"
    motor = "<actuator><velocity joint='a' kv='5' ctrlrange='-10 10'/></actuator>"
    option = f"<option integrator='{integrator}'/>"
    scene = load_scene(f"<mujoco>{option}<worldbody>{wheel}</worldbody>{motor}</mujoco>")
    if integrator == "implicitfast":  # the advice is right
        assert collect_trajectories(scene, 30, 50)["state"].isfinite().all()
        return
    with pytest.raises(UnstableSimulationError, match='Use <option integrator="implicitfast"/>.* or a smaller physics'):
        collect_trajectories(scene, 30, 50)


def test_unstable_policies_are_drawn_again() -> None:
    scene = zoo.load("cart", ('gear="1"', 'gear="1e12"'))

    def policy(entries):  # one of thirty blows up
        action = torch.zeros(len(entries), 1)
        action[:1] = float(len(entries) > 1)
        return action

    redrawn = {}
    data = collect_trajectories(scene, 30, 4, policy=policy, redrawn=redrawn)
    assert redrawn == {"unstable": 1, "outside": 0} and not data["action"].any()
    with pytest.raises(UnstableSimulationError, match="'cart' became unstable .* another policy"):
        collect_trajectories(scene, 30, 4, policy=lambda entries: torch.ones(len(entries), 1))


def test_bounds_redraw_and_count(tmp_path: Path, pendulum: Scene) -> None:
    free, redrawn = collect_trajectories(pendulum, 60, 50, seed=2), {}
    bounds = {"angular_speed": 6.0, "lowest": 0.5, "distance": 2.0, "highest": 0.7, "speed": 1.0}
    data = collect_trajectories(pendulum, 60, 50, seed=2, bounds=bounds, redrawn=redrawn)
    before, after = (torch.linalg.vector_norm(each["state"][:, :, 1, 10:], dim=-1) for each in (free, data))
    fast = before.amax(1) > 6
    assert after.max() <= 6
    assert torch.equal(data["state"][~fast], free["state"][~fast])
    assert redrawn["unstable"] == 0 and redrawn["outside"] >= fast.sum() > 10
    with pytest.raises(UnstableSimulationError, match=r"of 'pendulum' .* left the bounds \{'highest': 0.1\}"):
        collect_trajectories(pendulum, 5, 5, bounds={"highest": 0.1})
    for bad, message in (({"height": 1.0}, "no 'height'; use some of"), ({"speed": float("nan")}, "'speed'.*nan")):
        with pytest.raises(ValueError, match=message):
            collect_trajectories(pendulum, 5, 5, bounds=bad)
    sizes: Any = {"train": 20, "validation": 2, "test": 2, "steps": 50, "seed": 2}
    made = create_dataset(tmp_path / "d", pendulum, **sizes, bounds=bounds)
    assert made.manifest["request"]["bounds"] == bounds and made.rejected["train"] > 3
    with pytest.raises(RuntimeError, match="bounds is .*, not None"):
        create_dataset(tmp_path / "d", pendulum, **sizes)


def test_data_of_models_say_how_they_were_drawn(tmp_path: Path, pendulum: Scene) -> None:
    sizes: Any = {"train": 2, "validation": 1, "test": 1, "steps": 2}
    assert create_dataset(tmp_path / "a", zoo.load("pole"), **sizes).manifest["request"]["draws"] == 3
    assert "draws" not in create_dataset(tmp_path / "b", load_scene("pendulum"), **sizes).manifest["request"]
