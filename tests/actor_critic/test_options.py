"""Options are refused by name, before anything is played."""

from __future__ import annotations

import pytest

from torchrl_gn.actor_critic import ActorCriticOptions, EvaluationEpisodes, FirstTrajectories


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, "horizon=0 must be a whole number, 1 or more"),
        ({"updates": 2.5}, "updates=2.5 must be a whole number"),
        ({"model_steps": 0}, "model_steps=0 must be a whole number, 1 or more"),
        ({"average": 0}, "average=0 must be a whole number, 1 or more"),
        ({"seed": -1}, "seed=-1 must be a whole number, 0 or more"),
        ({"steps": 70}, "steps=70 must be a multiple of 50"),
        ({"members": 3, "batch_size": 2}, "batch_size=2 must be a whole number, 3 or more"),
        ({"value_lr": 0.0}, "value_lr=0.0 must be positive and finite"),
        ({"model_lr": float("inf")}, "model_lr=inf must be positive and finite"),
        ({"discount": 1.01}, "discount=1.01 must be above 0 and at most 1"),
        ({"lmbda": -0.1}, "lmbda=-0.1 must be from 0 to 1"),
        ({"outlier": float("nan")}, "outlier=nan must be above 0"),
        ({"novelty_rounds": -1}, "novelty_rounds=-1 must be a whole number, 0 or more"),
        ({"noise_color": 2.5}, "noise_color=2.5 must be from 0 to 2"),
        ({"noise_color": float("nan")}, "noise_color=nan must be from 0 to 2"),
        ({"pessimism": 1.0}, "pessimism=1.0 needs an ensemble: pass members=3"),
        ({"members": 2, "pessimism": float("nan")}, "pessimism=nan must be finite"),
        ({"policy": "cnn"}, "policy=cnn must be mlp or graph"),
        ({"hidden": 8}, "hidden=8 must be a list of sizes"),
        ({"hidden": [8, 0]}, r"hidden=\[8, 0\] must name hidden sizes of at least 1"),
    ],
    ids=lambda given: "-".join(given) if isinstance(given, dict) else "",
)
def test_refuses_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        ActorCriticOptions(**options)


@pytest.mark.parametrize(
    ("make", "option", "message"),
    [
        (FirstTrajectories, {"trajectories": 0}, "first.trajectories=0 must be a whole number, 1 or more"),
        (FirstTrajectories, {"length": 49}, "first.length=49 must be a whole number, 50 or more"),
        (FirstTrajectories, {"steps": 0}, "first.steps=0 must be a whole number, 1 or more"),
        (EvaluationEpisodes, {"episodes": 0}, "evaluate.episodes=0 must be a whole number, 1 or more"),
        (EvaluationEpisodes, {"steps": 0}, "evaluate.steps=0 must be a whole number, 1 or more"),
    ],
)
def test_refuses_parts_by_name(make, option, message):
    with pytest.raises(ValueError, match=message):
        make(**option)


def test_keeps_copies_and_takes_lists_as_tuples():
    hidden, model = [8], {"hidden": 8}
    options = ActorCriticOptions(hidden=hidden, model=model, members=2, pessimism=1.0)
    hidden.append(9)
    model["hidden"] = 9
    assert options == ActorCriticOptions(hidden=(8,), model={"hidden": 8}, members=2, pessimism=1.0)
