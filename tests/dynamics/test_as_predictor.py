"""Any TensorDict module with the methods of a predictor."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_gn.dynamics import BoundPredictor, as_predictor, specialize


def counting(state, action, count):
    return state + action.unsqueeze(-2) * count.unsqueeze(-1), count + 1


def module(*prefix: str) -> TensorDictModule:
    """Adds the action times the number of the step, which it counts itself, under nested keys or flat ones."""

    def key(*path: str):
        return path if len(path) > 1 else path[0]

    names = [key(*prefix, name) for name in ("state", "action", "count")]
    return TensorDictModule(counting, names, [key("next", *prefix, name) for name in ("state", "count")])


def check(prefix: tuple[str, ...]) -> None:
    model = as_predictor(module(*prefix))
    state, actions = torch.zeros(2, 3, 1), torch.tensor([[[1.0], [10.0]], [[2.0], [20.0]]])
    entries = {"count": torch.ones(2, 1)}
    for name in reversed(prefix):
        entries = {name: TensorDict(entries, [2])}
    start = model.hidden_state_in(TensorDict({**entries, "other": torch.zeros(2)}, [2]))
    before = start.clone()
    after, hidden = model.step(state, actions[:, 0], None, start)
    torch.testing.assert_close(after, actions[:, :1].expand(2, 3, 1))
    states, last = model.rollout(state, actions, None, start)
    assert torch.equal(states[:, 0], state) and torch.equal(states[:, 1], after)
    torch.testing.assert_close(states[:, 2], (actions[:, :1] + 2 * actions[:, 1:]).expand(2, 3, 1))
    where = (*prefix, "count")
    assert (start == before).all() and set(start.keys(True, True)) == set(before.keys(True, True))
    assert hidden[where].eq(2).all() and last[where].eq(3).all()
    assert list(last.keys(True, True)) == [where if prefix else "count"]


def test_a_modules_other_inputs_are_its_hidden_state():
    check(())
    check(("robot",))


@pytest.mark.slow
def test_a_predictor_of_nested_keys_is_itself(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    model = make_model(scene)
    nested = BoundPredictor(model, scene, state_key=("robot", "state"), action_key=("robot", "action"))
    quick = specialize(nested)
    state, actions = random_states(scene, 4, scale=0.1), random_actions(scene, 4, 3)
    expected = model.bind(scene).rollout(state, actions)[0]
    for predictor in (nested, quick):
        assert as_predictor(predictor) is predictor
        assert predictor.out_keys == [("next", "robot", "state")]
        torch.testing.assert_close(predictor.rollout(state, actions)[0], expected)
        robot = TensorDict({"robot": TensorDict({"state": state, "action": actions[:, 0]}, [4])}, [4])
        torch.testing.assert_close(predictor(robot)["next", "robot", "state"], expected[:, 1])
    # A module around it is wrapped, and steps as it does.
    around = TensorDictModule(nested, nested.in_keys, nested.out_keys)
    wrapped = as_predictor(around)
    assert wrapped is not around
    torch.testing.assert_close(wrapped.rollout(state, actions)[0], expected)
    torch.testing.assert_close(wrapped.teacher_forced(expected[:, :-1], actions)[0], expected[:, 1:])
