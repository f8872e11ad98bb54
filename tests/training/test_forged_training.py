"""Training states of an attacker: they are refused by name, or train on like any other."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrl_gn.training import Budget, Checkpoint, CheckpointError
from torchrl_gn.training.nested_state import flatten

PATH = Path("somebody's.safetensors")


def others(value: Any) -> Iterator[Any]:
    """Yield values that a forger may put in place of another."""
    if isinstance(value, Tensor):
        yield from (value.flatten()[:0], value.flatten()[: value.numel() // 2], torch.zeros(3, 2, 5), value.bool())
    yield from (-1, 10**400, math.nan, "5", None, [], [None], {}, True)


def places(state: Any, before: tuple = ()) -> Iterator[tuple]:
    """Paths of all entries; of many alike, the first three."""
    items: list = list(
        state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list) else ()
    )
    many = isinstance(state, list) or {"state", "best_weights", "losses"} & {*before}
    for key, value in items[:3] if many else items:
        yield (*before, key)
        yield from places(value, (*before, key))


def forgeries(state: dict) -> Iterator[tuple[str, dict]]:
    """The state with one entry missing, or exchanged."""
    for *before, last in places(state):
        for number in itertools.count(-1):
            forged = copy.deepcopy(state)
            holder: Any = forged
            for key in before:
                holder = holder[key]
            instead = list(others(holder[last]))
            if number == len(instead):
                break
            if number < 0:
                del holder[last]
            else:
                holder[last] = instead[number]
            yield f"{[*before, last]}: {'missing' if number < 0 else instead[number]}", forged


def refusals(state: dict, trainer: Any, go_on: Callable[[], object]) -> dict[str, str]:
    """Return the error of each refused forgery; an accepted one must train on and be saved again."""
    found = {}
    for what, forged in forgeries(state):
        checkpoint = Checkpoint(trainer, [], {}, {}, training=forged, path=PATH)
        try:
            checkpoint.resume(trainer.load_state_dict)
        except CheckpointError as error:
            assert str(error).startswith(f"Checkpoint {PATH} cannot resume this training: ")
            found[what] = str(error)
            continue
        try:
            go_on()
            flatten(trainer.state_dict(), "training", {})
        except FloatingPointError:
            pass  # numbers that are no good, of which it says so
        except Exception as error:
            raise AssertionError(f"{what} was not refused") from error
    return found


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["muon", "adam"])
def test_forged_states_of_a_forward_models_training_are_refused(make_trainer, preset):
    options = {"preset": preset, "unroll": 0.5, "validate": lambda: 1.0, "validations": 4}
    first = make_trainer(Budget(steps=8), **options)
    assert len(list(itertools.islice(first.run(), 4))) == 4 and first.best_weights
    state, trainer = copy.deepcopy(first.state_dict()), make_trainer(Budget(steps=8), **options)
    found = refusals(state, trainer, lambda: next(trainer.run(), None))
    assert len(found) > 400
    moment = "momentum_buffer" if preset == "muon" else "exp_avg_sq"
    assert any(moment in why and "is not a tensor" in why for why in found.values())


@pytest.mark.slow
def test_forged_states_of_a_policys_training_are_refused(make_learner):
    sizes = {"frames": 200, "random_frames": 20, "updates_per_frame": 0.1}
    first = make_learner(**sizes)
    for progress in first.run():
        if progress.frames == 100:
            break
    state, trainer = copy.deepcopy(first.state_dict()), make_learner(**sizes)
    assert len(refusals(state, trainer, lambda: next(trainer.run(), None))) > 400


def test_moments_of_another_shape_are_refused_before_a_kernel_writes_beyond_them(make_trainer):
    """A fused kernel would write beyond them, which ends the process."""
    first = make_trainer(Budget(steps=4), preset="adam")
    next(first.run())
    state = first.state_dict()
    state["optimizer"]["0"]["state"][0]["exp_avg_sq"] = torch.zeros(2)
    again = make_trainer(Budget(steps=4), preset="adam")
    with pytest.raises(ValueError, match=r"training.optimizer.state.exp_avg_sq is not a tensor \[\d+, \d+\] of"):
        again.load_state_dict(state)
