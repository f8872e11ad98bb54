"""The value of a linear system against its closed form, and the policy that played."""

from __future__ import annotations

import importlib
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import MultiStep

from torchrl_gn.policies import StatePolicy, StateValue
from torchrl_gn.training import fit_policy, fit_value, load_pretrained, save_checkpoint

from .. import zoo

STEP, DISCOUNT, GAIN, WEIGHTS = 0.1, 0.9, (1.5, 1.2), (1.0, 0.1)
A = np.array([[1.0, STEP], [0.0, 1.0]]) - np.outer([STEP**2, STEP], GAIN)  # with the policy u = -GAIN x


@pytest.fixture(scope="module")
def scene():
    return zoo.load("cart", ("-1 1", "-20 20"), timestep=STEP)


def bodies(points: torch.Tensor) -> torch.Tensor:
    """States ``[*B, 2, 13]`` of places and speeds ``[*B, 2]``."""
    state = torch.zeros(*points.shape[:-1], 2, 13, dtype=torch.float64)
    state[..., 3] = 1.0
    state[..., 1, 0], state[..., 1, 7] = points.unbind(-1)
    return state


def play(episodes: int = 200, steps: int = 15, seed: int = 0) -> TensorDict:
    """Episodes ``[M, T]`` under the policy, cut by a time limit."""
    rng = np.random.default_rng(seed)
    points = [rng.uniform(-1, 1, (episodes, 2))]
    for _ in range(steps):
        points.append(points[-1] @ A.T)
    path = torch.from_numpy(np.stack(points, axis=1))
    reward = -(path[:, 1:].square() * torch.tensor(WEIGHTS)).sum(-1, keepdim=True)
    state, action = bodies(path), -(path[:, :-1] @ torch.tensor(GAIN).double()).unsqueeze(-1)
    after = {"state": state[:, 1:], "reward": reward}
    return TensorDict({"state": state[:, :-1], "action": action, "next": after}, [episodes, steps])


def true_value(points: torch.Tensor) -> torch.Tensor:
    matrix = np.zeros((2, 2))
    for _ in range(500):
        matrix = A.T @ (np.diag(WEIGHTS) + DISCOUNT * matrix) @ A
    return -((points @ torch.from_numpy(matrix)) * points).sum(-1, keepdim=True)


def small(scene, **options) -> StateValue:
    torch.manual_seed(0)
    return StateValue(scene, **{"discount": DISCOUNT, "hidden": (64, 64), "members": 1, **options})


POINTS = torch.from_numpy(np.random.default_rng(1).uniform(-0.8, 0.8, (200, 2)))


@pytest.fixture(scope="module")
def learned(scene):
    value = small(scene)
    return value, fit_value(value, play(), iterations=20, steps=100, seed=0)


@pytest.mark.slow
def test_it_recovers_the_value_of_a_linear_system(learned):
    """Beyond the episodes' time limits, after which a fifth of the value is still to come."""
    value, history = learned
    with torch.no_grad():
        error = value(bodies(POINTS)) - true_value(POINTS)
    assert error.square().mean().sqrt() < 0.03 * true_value(POINTS).std()
    assert history.explained > 0.99 and history.losses[-1] < 0.1 * history.losses[0]


@pytest.mark.parametrize("fit", ["value", "policy"])
def test_padding_of_episodes_does_not_count(scene, fit):
    episodes, length, found = play(4, 6), torch.tensor([6, 4, 1, 5]), []
    parts = [episodes[row : row + 1, :steps] for row, steps in enumerate(length.tolist())]
    mask = torch.arange(6) < length[:, None]
    padded = episodes.apply(lambda each: torch.where(mask.reshape(4, 6, *[1] * (each.ndim - 2)), each, 0))
    padded["collector", "mask"] = mask
    for given in (padded, parts):
        torch.manual_seed(0)
        network = small(scene) if fit == "value" else StatePolicy(scene, hidden=[8])
        learn = partial(fit_value, iterations=3) if fit == "value" else fit_policy
        learn(network, given, steps=5)
        found.append([*network.parameters(), network.features.normalizer.mean])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other)


def test_rewards_of_several_steps_are_refused(scene):
    episodes = play(2, 6)
    ends = torch.zeros(2, 6, 1, dtype=torch.bool)
    episodes["next", "done"] = episodes["next", "terminated"] = ends
    with pytest.raises(ValueError, match="fit_value needs transitions of one step, the batch has some of 3"):
        fit_value(small(scene), MultiStep(0.9, 3)(episodes))


def test_where_an_episode_terminated_nothing_follows(scene):
    episodes = play(steps=1)
    rewards = torch.full_like(episodes["next", "reward"], -1.0)
    episodes["next", "reward"] = rewards
    ended = torch.ones_like(rewards, dtype=torch.bool)
    for terminated, expected in ((ended, -1.0), (~ended, -1 / (1 - DISCOUNT))):
        episodes["next", "terminated"], episodes["next", "done"] = terminated, ended
        value = small(scene)
        fit_value(value, episodes, iterations=3, steps=5)
        torch.testing.assert_close(value(episodes["state"]), torch.full_like(rewards, expected))


def test_the_smallest_of_its_networks_counts(scene):
    value = small(scene, members=3)
    fit_value(value, play(4), iterations=1, steps=1)
    state = bodies(POINTS[:5])
    every = value.normalizer.inverse(value.normalized(value.features(state, torch.float32)))
    assert every.std(-1).min() > 0
    torch.testing.assert_close(value(state), every.amin(-1, keepdim=True).double())


def test_a_seed_repeats_it_and_several_lengths_go_together(scene):
    parts = [play(4), play(3, 7, seed=1)]
    found = []
    for seed in (0, 0, 1):
        value = small(scene)
        fit_value(value, parts, iterations=2, steps=3, seed=seed)
        found.append(value(bodies(POINTS[:5])))
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])


def test_gradient_and_hessian_are_those_of_finite_differences(learned):
    value = learned[0].double()
    x, eps = torch.tensor([0.3, -0.4], dtype=torch.float64), 1e-4

    def of(point: torch.Tensor) -> torch.Tensor:
        return value(bodies(point)).squeeze()

    steps = eps * torch.eye(2).double()
    by_differences = torch.stack([(of(x + step) - of(x - step)) / (2 * eps) for step in steps])
    torch.testing.assert_close(torch.autograd.functional.jacobian(of, x), by_differences, rtol=1e-5, atol=1e-6)
    hessian = torch.autograd.functional.hessian(of, x)
    second = torch.stack(
        [
            torch.autograd.functional.jacobian(of, x + step) - torch.autograd.functional.jacobian(of, x - step)
            for step in steps
        ]
    )
    torch.testing.assert_close(hessian, second / (2 * eps), rtol=1e-4, atol=1e-5)
    value.float()


@pytest.mark.slow
def test_the_policy_acts_as_in_the_episodes(scene):
    torch.manual_seed(0)
    policy = StatePolicy(scene, hidden=(64, 64))
    history = fit_policy(policy, play(), steps=1500, seed=0)
    action = policy(TensorDict({"state": bodies(POINTS)}, [200]))["action"].detach()
    expected = -(POINTS @ torch.tensor(GAIN).double()).unsqueeze(-1).float()
    assert (action - expected).square().mean().sqrt() < 0.05 * expected.std()
    assert history.losses[-1] < 0.1 * history.losses[0] and len(history.losses) == 10


@pytest.mark.parametrize("combine", ["min", "mean"])
def test_networks_are_combined(scene, tmp_path, combine):
    value, state = small(scene, members=3, combine=combine), bodies(POINTS)
    value.features.fit(state)
    value.normalizer.update(torch.tensor([[-3.0], [5.0]]))
    with torch.no_grad():
        features = value.features(state, torch.float32)
        each = torch.stack([value.normalizer.inverse(member(features)) for member in value.members])
        wanted = each.amin(0) if combine == "min" else each.mean(0)
        torch.testing.assert_close(value(state), wanted.double(), rtol=1e-5, atol=1e-5)
        save_checkpoint(tmp_path / "value.safetensors", value, scene=scene)
        again = load_pretrained(tmp_path / "value.safetensors").value
        assert torch.equal(again(state), value(state))


def test_checkpoints_hold_them(learned, scene, tmp_path):
    value, policy = learned[0], StatePolicy(scene, hidden=(8,))
    fit_policy(policy, play(4), steps=1)
    for name, network in (("value", value), ("policy", policy)):
        path = tmp_path / f"{name}.safetensors"
        save_checkpoint(path, network, scene=scene)
        state, loaded = bodies(POINTS[:5]), getattr(load_pretrained(path), name)
        same = [each(state) if name == "value" else each.act(state) for each in (network, loaded)]
        assert torch.equal(*same) and loaded.fitted and loaded.scene.name == scene.name
    assert load_pretrained(tmp_path / "value.safetensors").value.discount == DISCOUNT
    content = bytearray((tmp_path / "value.safetensors").read_bytes())
    content[-3] ^= 1
    (tmp_path / "value.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="damaged"):
        load_pretrained(tmp_path / "value.safetensors")


@pytest.mark.parametrize(
    ("key", "match"),
    [("state", "'state' of episodes number 1"), (("next", "reward"), r"\('next', 'reward'\) of episodes number 1")],
)
def test_numbers_that_are_not_finite_are_refused_by_name(scene, key, match):
    parts = [play(2), play(2)]
    parts[1][key][0, 3, 0] = torch.nan
    value = small(scene)
    with pytest.raises(ValueError, match=match):
        fit_value(value, parts)
    assert not value.fitted


def test_other_bad_inputs_are_refused_by_name(scene):
    value, good = small(scene), play(2)
    with pytest.raises(ValueError, match=r"no entry \('next', 'reward'\)"):
        fit_value(value, good.exclude(("next", "reward")))
    with pytest.raises(ValueError, match=r"\[M, T\], number 0 is \[15\]"):
        fit_value(value, good[0])
    for none in ([], good[:0], good[:, :0]):
        with pytest.raises(ValueError, match="no played episodes"):
            fit_value(value, none)
    with pytest.raises(ValueError, match="lmbda=2"):
        fit_value(value, good, lmbda=2)
    with pytest.raises(ValueError, match="iterations=0"):
        fit_value(value, good, iterations=0)
    wide = good.clone().set("action", torch.zeros(2, 15, 2))
    with pytest.raises(ValueError, match=r"actions must be \[M, T, 1\]"):
        fit_policy(StatePolicy(scene), wide)
    for options in ({"discount": 0.0}, {"discount": 1.5}, {"members": 0}, {"hidden": ()}, {"combine": "max"}):
        with pytest.raises(ValueError, match=next(iter(options))):
            StateValue(scene, **options)


def test_rows_that_go_on_elsewhere_without_an_end_are_refused(scene):
    rows = torch.cat((play(4, 5), play(4, 5, seed=1)), 1)
    with pytest.raises(ValueError, match="step 5 of row 0 does not start where step 4 ended"):
        fit_value(small(scene), rows, iterations=1, steps=1)
    done = torch.zeros(4, 10, 1, dtype=torch.bool)
    done[:, 4] = True
    fit_value(small(scene), rows.set(("next", "done"), done), iterations=1, steps=1)


def test_actions_beyond_the_bounds_count_as_executed(scene):
    """Half the actions are 1.5 times the upper bound, half the lower: their executed mean is 0."""
    low, high = scene.action_low[0], scene.action_high[0]
    states = bodies(torch.zeros(50, 4, 2, dtype=torch.float64))
    action = torch.where(torch.arange(50).reshape(-1, 1, 1) % 2 == 0, 1.5 * high, low).expand(50, 4, 1).double()
    torch.manual_seed(0)
    policy = StatePolicy(scene, hidden=(8,))
    fit_policy(policy, TensorDict({"state": states, "action": action}, [50, 4]), steps=300, batch_size=200, lr=0.02)
    assert abs(policy.act(states[0, :1]).item() / high) < 0.02


@pytest.mark.parametrize("lmbda", [0.0, 1e-9, 0.5, 1.0])
@pytest.mark.parametrize(
    ("given", "terminated"),
    [
        ({"done": [3], "terminated": [3]}, [3]),
        ({"done": [3], "terminated": []}, []),
        ({"done": [3]}, [3]),  # as in TorchRL
        ({"done": [3], "truncated": [3]}, []),
        ({"truncated": [3], "terminated": [1]}, [1]),  # Gymnasium has no done
        ({}, []),
    ],
)
def test_targets_are_returns_until_the_end(scene, monkeypatch, lmbda, given, terminated):
    episodes, found = play(2, 6), []
    for name in ("done", "terminated", "truncated"):
        episodes = episodes.exclude(("next", name))
    for name, steps in given.items():
        flags = torch.zeros(2, 6, dtype=torch.bool)
        flags[1, steps] = True
        episodes["next", name] = flags.float()  # any dtype, without a last dimension
    rewards, ends = episodes["next", "reward"].double(), {step for steps in given.values() for step in steps}
    forever, value = rewards.mean() / (1 - DISCOUNT), small(scene)
    monkeypatch.setattr(
        importlib.import_module("torchrl_gn.training.fit_value"),  # the package's attribute is the function
        "fit_batches",
        lambda predict, features, targets, *_, **__: found.append(value.normalizer.inverse(targets)) or torch.zeros(1),
    )
    fit_value(value, episodes, lmbda=lmbda, iterations=1)
    expected = torch.zeros_like(rewards)
    for row in range(2):
        for step in reversed(range(6)):
            after = 0.0 if row == 1 and step in terminated else forever
            if step < 5 and not (row == 1 and step in ends):
                after = (1 - lmbda) * after + lmbda * expected[row, step + 1]
            expected[row, step] = rewards[row, step] + DISCOUNT * after
    torch.testing.assert_close(found[0].double(), expected.reshape(-1, 1), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_it_learns_without_gradients_around_it(scene, mode):
    networks = []
    for context in (torch.enable_grad, mode):
        torch.manual_seed(0)
        networks.append((small(scene), StatePolicy(scene, hidden=[8])))
        with context():
            fit_value(networks[-1][0], play(2, 6), iterations=2, steps=3)
            fit_policy(networks[-1][1], play(2, 6), steps=3)
    for usual, found in zip(*networks, strict=True):
        for one, other in zip(usual.parameters(), found.parameters(), strict=True):
            assert torch.equal(one, other) and not other.is_inference()


def test_networks_with_a_target_read_that_of_the_episodes(scene):
    """The first body's place relative to the target decides value and action: shifting both changes nothing."""
    episodes, found = play(4, 6), []
    for shift in (0.0, 2.0):
        moved = episodes.clone()
        for state in (moved["state"], moved["next", "state"]):
            state[..., 1, 0] += shift
        moved["target"] = torch.tensor([shift, 0.0, 0.0]).expand(4, 6, 3).double()
        torch.manual_seed(0)
        networks = StateValue(scene, hidden=[8], target=True), StatePolicy(scene, hidden=[8], target=True)
        fit_value(networks[0], moved, iterations=1, steps=3)
        fit_policy(networks[1], moved, steps=3)
        state, target = moved["state"], moved["target"]
        found.append((networks[0](state, target), networks[1].act(state, target)))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one.float(), other.float(), rtol=1e-4, atol=1e-4)
    for fit, network in zip((fit_value, fit_policy), networks, strict=True):
        with pytest.raises(ValueError, match="Episodes number 0 have no entry 'target'"):
            fit(network, episodes)


@pytest.mark.parametrize("padded", [False, True])
def test_a_target_that_moves_within_an_episode_counts_where_it_is_after_the_step(scene, monkeypatch, padded):
    """The value after a step was taken for the target before it."""
    torch.manual_seed(0)
    episodes, found = play(2, 6), []
    way = torch.rand(2, 7, 3, dtype=torch.double)
    episodes["target"], episodes["next", "target"] = way[:, :-1], way[:, 1:]
    value = StateValue(scene, hidden=[8], target=True, discount=DISCOUNT)
    fit_value(value, episodes, iterations=1, steps=3)
    monkeypatch.setattr(
        importlib.import_module("torchrl_gn.training.fit_value"),
        "fit_batches",
        lambda predict, features, targets, *_, **__: found.append(value.normalizer.inverse(targets)) or torch.zeros(1),
    )
    with torch.no_grad():
        after = value(episodes["next", "state"], way[:, 1:])
    terminated = episodes["next"].get("terminated", torch.zeros(2, 6, 1, dtype=torch.bool))
    expected = episodes["next", "reward"] + DISCOUNT * torch.where(terminated, 0.0, after)
    if padded:
        mask = torch.ones(2, 6, dtype=torch.bool)
        mask[1, 3:] = False
        episodes["next", "target"][1, 3:] = torch.nan
        episodes["mask"], expected = mask, expected[mask]
    fit_value(value, episodes, iterations=1, lmbda=0.0)
    torch.testing.assert_close(found[0].double(), expected.double().reshape(-1, 1), rtol=1e-5, atol=1e-5)
