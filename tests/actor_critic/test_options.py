"""Options are refused by name, before anything is played."""

from __future__ import annotations

import pytest

from torchrl_gn.actor_critic import ActorCriticOptions, EvaluationEpisodes, FirstTrajectories


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, "horizon must be at least 1, got 0"),
        ({"updates": 2.5}, "updates must be a whole number, got 2.5"),
        ({"model_steps": 0}, "model_steps must be at least 1"),
        ({"average": 0}, "average must be at least 1"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"steps": 70}, "steps=70 must be a multiple of 50"),
        ({"members": 3, "batch_size": 2}, "batch_size must be at least 3"),
        ({"value_lr": 0.0}, "value_lr=0.0 must be positive and finite"),
        ({"model_lr": float("inf")}, "model_lr=inf must be positive and finite"),
        ({"discount": 1.01}, "discount=1.01 must be above 0 and at most 1"),
        ({"lmbda": -0.1}, "lmbda=-0.1 must be from 0 to 1"),
        ({"outlier": float("nan")}, "outlier=nan must be above 0"),
        ({"novelty_rounds": -1}, "novelty_rounds must be at least 0, got -1"),
        ({"noise_color": 2.5}, "noise_color=2.5 must be from 0 to 2"),
        ({"noise_color": float("nan")}, "noise_color=nan must be from 0 to 2"),
        ({"pessimism": 1.0}, "pessimism=1.0 needs an ensemble: give members=3"),
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
        (FirstTrajectories, {"trajectories": 0}, "first.trajectories must be at least 1"),
        (FirstTrajectories, {"length": 49}, "first.length must be at least 50, got 49"),
        (FirstTrajectories, {"steps": 0}, "first.steps must be at least 1"),
        (EvaluationEpisodes, {"episodes": 0}, "evaluate.episodes must be at least 1"),
        (EvaluationEpisodes, {"steps": 0}, "evaluate.steps must be at least 1"),
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
