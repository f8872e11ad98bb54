"""NaN and infinity at every place where a user's numbers come in: an error that names them, or a flag."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_gn.data import (
    Simulator,
    collect_trajectories,
    create_dataset,
    sample_start_states,
    spline_controls,
    trajectory_buffer,
)
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import evaluate_errors, guarded_rollout, rollout, rollout_video
from torchrl_gn.maths import Normalizer
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.rewards import Balance
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import Budget, Trainer, load_pretrained, make_optimizer, save_checkpoint
from torchrl_gn.training.optimizers import ScheduledOptimizer
from torchrl_gn.training.tensor_files import read_tensors, write_tensors

from . import zoo
from .sizes import SMALL


@pytest.fixture(scope="module")
def scene():
    return load_scene("pendulum")


@pytest.fixture
def given(scene, tmp_path, monkeypatch) -> SimpleNamespace:
    """Good numbers to spoil one of: trajectories, a batch, physics states, physical parameters, models."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, **SMALL)
    trajectories = collect_trajectories(scene, 4, 6, seed=0)
    batch = trajectory_buffer(trajectories, batch_size=5, seed=0).sample().exclude("index")
    loss = ForwardModelLoss(model.bind(scene))
    loss.fit_normalizers(batch)
    variants = model.bind(scene, parameters_key="parameters")
    parameters = torch.stack([variants.parameters_of(scene)] * 5)
    physics = torch.as_tensor(sample_start_states(scene, 5, 0))
    return SimpleNamespace(
        scene=scene,
        trajectories=trajectories,
        batch=batch,
        own=batch.clone().set("parameters", parameters),
        own_trajectories=trajectories.clone().set("parameters", parameters[:4]),
        parameters=parameters,
        physics=physics,
        start=TensorDict({"physics": physics, "action": torch.zeros(5, 1)}, [5]),
        model=model,
        bound=loss.model,
        variants=variants,
        loss=loss,
        path=tmp_path,
    )


def spoil(data: Any, bad: float, key: Any = None) -> Any:
    """A copy with a bad number in row 2 of a tensor, an array, or an entry of a TensorDict."""
    data = data.copy() if isinstance(data, np.ndarray) else data.clone()
    entry = data if key is None else data[key]
    entry[2, ..., -1] = bad
    return data


def spoiled_checkpoint(g: SimpleNamespace, bad: float) -> None:
    """Write and load a checkpoint that is whole, of a model that is not."""
    save_checkpoint(g.path / "bad.safetensors", g.model, scene=g.scene)
    tensors, metadata = read_tensors(g.path / "bad.safetensors")
    tensors["model.core.first.edge_mlp.0.bias"][0] = bad
    write_tensors(g.path / "bad.safetensors", tensors, format=metadata["format"])
    load_pretrained(g.path / "bad.safetensors")


def spoiled_model(g: SimpleNamespace, bad: float) -> None:
    """Write a model that is not whole."""
    with torch.no_grad():
        g.model.core.first.edge_mlp[0].bias[0] = bad
    save_checkpoint(g.path / "bad.safetensors", g.model, scene=g.scene)


def trainer(g: SimpleNamespace, **options) -> Trainer:
    buffer = trajectory_buffer(g.trajectories, batch_size=5)
    return Trainer(g.loss, buffer, make_optimizer(g.model), Budget(steps=1), **options)


class Entry(NamedTuple):
    """An entry point: a way to pass it a bad number, and the names that the message must have."""

    where: str
    call: Callable[[SimpleNamespace, float], object]
    message: str
    bad: tuple[float, ...] = (math.nan, math.inf)


NUMBER = r"(nan|inf)"
AT_2 = rf" has {NUMBER} at index \(2, "

ENTRIES = [
    # Scenes
    Entry(
        "MJCF",
        lambda g, bad: zoo.load("pole", ('damping=".1"', f'damping="{bad}"')),
        rf"dof_damping of joint .* is {NUMBER}|Nan, Inf",
    ),
    Entry("timestep", lambda g, bad: load_scene("pendulum", timestep=bad), rf"timestep={NUMBER}"),
    # Data
    Entry(
        "simulated physics",
        lambda g, bad: Simulator(g.scene).rollout(spoil(g.physics, bad), np.zeros((5, 3, 1))),
        "physics" + AT_2,
    ),
    Entry(
        "simulated actions",
        lambda g, bad: Simulator(g.scene).rollout(g.physics, spoil(np.zeros((5, 3, 1)), bad)),
        "actions" + AT_2,
    ),
    Entry("observed physics", lambda g, bad: Simulator(g.scene).observe(spoil(g.physics, bad)), "physics" + AT_2),
    Entry(
        "settled physics", lambda g, bad: Simulator(g.scene).settle(spoil(g.physics.numpy(), bad), 2), "physics" + AT_2
    ),
    Entry(
        "knots of controls",
        lambda g, bad: spline_controls(g.scene, 2, 3, 0, knot_interval=bad),
        rf"knot_interval .* got {NUMBER}",
    ),
    Entry(
        "knots of trajectories",
        lambda g, bad: collect_trajectories(g.scene, 2, 3, knot_interval=bad),
        rf"knot_interval .* got {NUMBER}",
    ),
    Entry(
        "knots of a data set",
        lambda g, bad: create_dataset(g.path / "data", g.scene, 2, 2, 2, 3, knot_interval=bad),
        rf"knot_interval .* got {NUMBER}",
    ),
    # Modules
    Entry(
        "normaliser", lambda g, bad: Normalizer(3).update(spoil(torch.ones(4, 3), bad)), r"NaN or Inf in features \[2\]"
    ),
    Entry("normaliser's floor", lambda g, bad: Normalizer(3, floor=bad), rf"floor={NUMBER}"),
    Entry(
        "statistics of physical parameters",
        lambda g, bad: update_parameter_normalizers(g.variants, spoil(g.parameters, bad, "nodes")),
        "parameters 'nodes'" + AT_2,
    ),
    Entry(
        "statistics of transitions",
        lambda g, bad: update_dynamic_normalizers(
            g.bound, g.batch["state"], spoil(g.batch["action"], bad), g.batch["next", "state"]
        ),
        "action" + AT_2,
    ),
    # Rewards
    Entry(
        "reward's target", lambda g, bad: Balance(g.scene, ["pole"], target=torch.full((4,), bad)), "target .* finite"
    ),
    # Loss
    *(
        Entry(
            f"{what} {key}",
            lambda g, bad, run=run, key=key: run(g.loss)(spoil(g.batch, bad, key)),
            rf"{'state' if 'state' in key else key}'\)? of the batch" + AT_2,
        )
        for what, run in (("loss", lambda loss: loss), ("fitted", lambda loss: loss.fit_normalizers))
        for key in ("state", "action", ("next", "state"))
    ),
    Entry(
        "loss parameters",
        lambda g, bad: ForwardModelLoss(g.variants)(spoil(g.own, bad, ("parameters", "edges"))),
        "'parameters' of the batch 'edges'" + AT_2,
    ),
    Entry(
        "fitted parameters",
        lambda g, bad: ForwardModelLoss(g.variants).fit_normalizers(spoil(g.own, bad, ("parameters", "child_anchor"))),
        "'parameters' of the batch 'child_anchor'" + AT_2,
    ),
    Entry("noise", lambda g, bad: ForwardModelLoss(g.bound, noise=bad), rf"noise={NUMBER}"),
    # Environments
    Entry("true step action", lambda g, bad: SceneEnv(g.scene).step(spoil(g.start, bad, "action")), "'action'" + AT_2),
    Entry(
        "true step physics", lambda g, bad: SceneEnv(g.scene).step(spoil(g.start, bad, "physics")), "'physics'" + AT_2
    ),
    Entry(
        "true reset",
        lambda g, bad: SceneEnv(g.scene).reset(spoil(g.start, bad, "physics"), set_state=True),
        r"SceneEnv\('pendulum'\): 'physics'" + AT_2,
    ),
    Entry(
        "imagined reset",
        lambda g, bad: ModelEnv(g.bound).reset(spoil(g.batch, bad, "state"), set_state=True),
        r"ModelEnv\('pendulum'\): 'state'" + AT_2,
    ),
    Entry(
        "imagined reset parameters",
        lambda g, bad: ModelEnv(g.variants).reset(spoil(g.own, bad, ("parameters", "nodes")), set_state=True),
        r"ModelEnv\('pendulum'\): 'parameters' 'nodes'" + AT_2,
    ),
    Entry(
        "start states",
        lambda g, bad: SceneEnv(g.scene, start_states=spoil(g.physics, bad)),
        "start state 2 of 'pendulum' is not finite",
    ),
    Entry(
        "start states of a function",
        lambda g, bad: SceneEnv(g.scene, start_states=lambda n, rng: spoil(g.physics[:n], bad)).reset(
            TensorDict(batch_size=[5])
        ),
        "start state 2 of 'pendulum' is not finite",
    ),
    Entry(
        "true unstable_reward", lambda g, bad: SceneEnv(g.scene, unstable_reward=bad), f"unstable_reward .* {NUMBER}"
    ),
    Entry(
        "imagined unstable_reward",
        lambda g, bad: ModelEnv(g.bound, unstable_reward=-bad),
        f"unstable_reward .* -?{NUMBER}",
    ),
    # Evaluation
    *(
        Entry(
            f"errors {key}",
            lambda g, bad, key=key: evaluate_errors(g.bound, spoil(g.trajectories, bad, key), horizons=(3,)),
            f"Trajectory 2 contains {key}s that are not finite",
        )
        for key in ("state", "action")
    ),
    Entry(
        "errors parameters",
        lambda g, bad: evaluate_errors(g.variants, spoil(g.own_trajectories, bad, ("parameters", "rest")), horizons=()),
        "parameters of the trajectories 'rest'" + AT_2,
    ),
    *(
        Entry(
            f"{run.__name__} {what}",
            lambda g, bad, run=run, what=what: run(
                g.variants,
                **{
                    name: spoil(value, bad, "pivot" if what == "parameters" else None) if name == what else value
                    for name, value in (
                        ("state", g.batch["state"]),
                        ("actions", torch.zeros(5, 3, 1)),
                        ("parameters", g.parameters),
                    )
                },
            ),
            f"{what}.*{AT_2}",
        )
        for run in (rollout, guarded_rollout)
        for what in ("state", "actions", "parameters")
    ),
    Entry(
        "guard's limit",
        lambda g, bad: guarded_rollout(g.bound, g.batch["state"], torch.zeros(5, 3, 1), limit=bad),
        "limit=nan",
        (math.nan,),
    ),
    Entry(
        "video",
        lambda g, bad: rollout_video(g.scene, spoil(g.trajectories["state"][0], bad), None, g.path / "x.gif"),
        "true states .* not finite",
    ),
    Entry(
        "video's speed",
        lambda g, bad: rollout_video(g.scene, g.trajectories["state"][0], None, g.path / "x.gif", speed=bad),
        f"speed .* got {NUMBER}",
    ),
    # Training
    Entry("steps", lambda g, bad: Budget(steps=bad), f"steps={NUMBER} must be a whole number"),
    Entry("minutes", lambda g, bad: Budget(minutes=bad), f"minutes={NUMBER} must be positive"),
    *(
        Entry(f"lr of {preset}", lambda g, bad, p=preset: make_optimizer(g.model, p, lr=bad), f"lr={NUMBER}")
        for preset in ("muon", "adam", "paper")
    ),
    Entry(
        "max_norm",
        lambda g, bad: ScheduledOptimizer(make_optimizer(g.model).optimizers, lambda *_: 1.0, max_norm=bad),
        "max_norm=nan",
        (math.nan,),
    ),
    Entry("unroll_fraction", lambda g, bad: trainer(g, unroll_fraction=bad), f"unroll_fraction={NUMBER}"),
    Entry("model to save", spoiled_model, r"not written, as 'model.core.first.edge_mlp.0.bias' has NaN or Inf"),
    Entry("checkpoint", spoiled_checkpoint, r"bad.safetensors has NaN or Inf in 'model.core.first.edge_mlp.0.bias'"),
]


@pytest.mark.parametrize(
    ("entry", "bad"),
    [pytest.param(entry, bad, id=f"{entry.where}: {bad}") for entry in ENTRIES for bad in entry.bad],
)
def test_a_bad_number_is_named_where_it_comes_in(given, entry, bad):
    before = {name: value.clone() for name, value in given.model.state_dict().items() if "normalizer" in name}
    with pytest.raises(ValueError, match=entry.message):
        entry.call(given, bad)
    for name, value in before.items():  # no statistic has taken part of it
        assert torch.equal(given.model.state_dict()[name], value), name
    assert not (given.path / "data").exists()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("key", ["state", "action", ("parameters", "nodes")], ids=str)
@pytest.mark.parametrize("special", [False, True])
def test_an_imagined_step_flags_it(given, key, bad, special):
    """A planner's search goes on with the other candidates."""
    env = ModelEnv(specialize(given.variants) if special else given.variants)
    after = env.step(spoil(given.own, bad, key))["next"]
    assert after["terminated"].flatten().tolist() == [False, False, True, False, False]
    assert after["reward"].flatten().tolist() == [0, 0, -1e6, 0, 0]
    rest: Tensor = torch.arange(5) != 2
    assert after["state"][rest].isfinite().all()
    if key != "state":
        assert torch.equal(after["state"][2], given.own["state"][2])
