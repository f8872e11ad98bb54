"""Options are checked in one way."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.checks import checked_seed
from torchrl_gn.data.controls import numpy_generator
from torchrl_gn.data.replay import WindowSampler
from torchrl_gn.envs import SuiteTaskEnv, batched, suite_env
from torchrl_gn.objectives import ForwardModelLoss, IdentificationLoss, SVGLoss
from torchrl_gn.policies import StatePolicy, StateReward, StateValue
from torchrl_gn.training import Budget, Trainer, fit_physics, make_optimizer, mean_return

from .sizes import SMALL


@pytest.mark.parametrize("seed", [0, 2**63 - 1, np.int64(7), np.uint8(7)])
def test_whole_numbers_are_seeds(seed):
    assert type(checked_seed(seed)) is int and checked_seed(seed) == seed
    torch.Generator().manual_seed(checked_seed(seed))
    assert numpy_generator(seed).random() == np.random.default_rng(int(seed)).random()


@pytest.mark.parametrize("seed", [True, 1.5, 1.0, -1, 2**63, "1", np.bool_(True), np.float64(1), torch.tensor(1)])
def test_other_seeds_are_refused_by_name(seed):
    for use in (checked_seed, numpy_generator, lambda seed: WindowSampler(seed=seed)):
        with pytest.raises(ValueError, match="seed=.* must be a whole number from 0 to"):
            use(seed)


@pytest.fixture(scope="module")
def calls():
    """Calls by the option that is a number of things; each takes the number."""
    scene = gn.load_scene("pendulum")
    data = gn.collect_trajectories(scene, 2, 5, seed=0)
    model = gn.ForwardModel.for_scene(scene, **SMALL).bind(scene)
    env, optimizer = gn.SceneEnv(scene), make_optimizer(model.model)

    def buffer(**options):
        return gn.trajectory_buffer(data, **{"batch_size": 2, **options})

    def trainer(**options):
        return Trainer(ForwardModelLoss(model), buffer(), optimizer, Budget(steps=1), **options)

    def identification(**options):
        return IdentificationLoss(None, scene, **options)  # type: ignore[arg-type]

    return {
        "steps": [
            lambda n: Budget(steps=n),
            lambda n: gn.fit(model, data, steps=n, progress=False),
            lambda n: gn.collect_trajectories(scene, 2, n),
            lambda n: fit_physics(torch.nn.Linear(1, 1), scene, data, steps=n),
            lambda n: mean_return(env, StatePolicy(scene), n),
            lambda n: suite_env("cartpole", "swingup", steps=n),
        ],
        "num": [lambda n: gn.collect_trajectories(scene, n, 5)],
        "batch_size": [
            lambda n: gn.fit(model, data, steps=1, batch_size=n, progress=False),
            lambda n: buffer(batch_size=n),
            lambda n: batched(env, 2, n),
            lambda n: gn.evaluate_errors(model, data, horizons=(2,), batch_size=n),
        ],
        "window": [lambda n: buffer(window=n), lambda n: fit_physics(torch.nn.Linear(1, 1), scene, data, window=n)],
        "capacity": [lambda n: buffer(capacity=n)],
        r"query_windows\[1\]": [lambda n: buffer(query_windows=(1, n))],
        r"shard\[1\]": [lambda n: buffer(shard=(0, n))],
        "teacher_forced_steps": [lambda n: ForwardModelLoss(model, teacher_forced_steps=n)],
        "bptt_steps": [lambda n: ForwardModelLoss(model, bptt_steps=n)],
        "context_length": [lambda n: identification(context_length=n)],
        "num_queries": [lambda n: identification(num_queries=n)],
        "shortest": [lambda n: identification(shortest=n)],
        "num_envs": [
            lambda n: suite_env("cartpole", "swingup", num_envs=n),
            lambda n: SuiteTaskEnv(gn.load_scene("suite:cartpole/swingup"), num_envs=n),
        ],
        "members": [lambda n: StateValue(scene, members=n)],
        "validations": [lambda n: trainer(validations=n)],
        "patience": [lambda n: trainer(patience=n)],
        "each of horizons": [lambda n: gn.evaluate_errors(model, data, horizons=(2, n))],
        "burn_in": [lambda n: gn.evaluate_errors(model, data, horizons=(2,), burn_in=n)],
    }


@pytest.mark.parametrize("number", [1.5, 2.0, True, "2", -1])
def test_numbers_of_things_are_whole(calls, number):
    """Others were rounded (1.5 steps were 2), taken, or ended in errors of Python's or PyTorch's."""
    for name, uses in calls.items():
        for use in uses:
            with pytest.raises(ValueError, match=f"{name}={number!r} must be a whole number, [01] or more"):
                use(number)


@pytest.mark.parametrize("hidden", [[8.0], [True], [0], [8, 1.5], []])
def test_hidden_sizes_are_whole_numbers(hidden):
    for network in (StateValue, StatePolicy, StateReward):
        with pytest.raises(ValueError, match="must name hidden sizes of at least 1"):
            network(gn.load_scene("pendulum"), hidden=hidden)


def test_numbers_of_imagined_steps_may_be_zero():
    for number in (-1, 1.5, True):
        with pytest.raises(ValueError, match=f"steps={number} must be a whole number, 0 or more"):
            SVGLoss(None, None, steps=number)  # type: ignore[arg-type]
