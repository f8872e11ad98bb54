"""Stochastic value gradients against derivatives by hand, against DDPG, and in TorchRL's contract."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import DDPGLoss, HardUpdate, ValueEstimators

from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.objectives import SVGLoss
from torchrl_gn.policies import Agent
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import ObservationGraph

from ..sizes import SMALL

# x' = a x + b u for -(q x^2 + rho u^2), with u = k x; exact in float32 is gamma.
A, B, Q, RHO, K, GAMMA = 0.9, 0.4, 1.3, 0.2, -0.7, 0.875

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")


class Weights(nn.Module):
    """A function with its own weights."""

    def __init__(self, function, *weights: float) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.tensor(weights, dtype=torch.float64))
        self.function = function

    def forward(self, *inputs: Tensor):
        return self.function(self.weights, *inputs)


def quadratic(w: Tensor, x: Tensor, u: Tensor) -> Tensor:
    return w[0] * x**2 + w[1] * x * u + w[2] * u**2


def exact_value() -> tuple[float, float, float]:
    """Weights of the quadratic ``Q(x, u)`` of the policy ``u = k x``."""
    curve = (Q + RHO * K**2) / (1 - GAMMA * (A + B * K) ** 2)
    return -Q - GAMMA * curve * A**2, -2 * GAMMA * curve * A * B, -RHO - GAMMA * curve * B**2


def reward(x: Tensor, u: Tensor, _: Tensor) -> Tensor:
    return -(Q * x**2 + RHO * u**2)


def make_policy(scale: float | None) -> TensorDictModule | ProbabilisticActor:
    if scale is None:
        return TensorDictModule(Weights(lambda w, x: w[0] * x, K), ["observation"], ["action"])
    gaussian = Weights(lambda w, x: (w[0] * x, w[1].expand_as(x)), K, scale)
    parameters = TensorDictModule(gaussian, ["observation"], ["loc", "scale"])
    return ProbabilisticActor(
        parameters, in_keys=["loc", "scale"], out_keys=["action"], distribution_class=IndependentNormal
    )


def make_loss(steps: int, *, value=(-2.0, -0.5, -0.8), scale=None, gamma=GAMMA, **options) -> SVGLoss:
    model = Weights(lambda w, x, u: w[0] * x + w[1] * u, A, B)
    loss = SVGLoss(
        make_policy(scale),
        ValueOperator(Weights(quadratic, *value), in_keys=["observation", "action"]),
        TensorDictModule(model, ["observation", "action"], [("next", "observation")]),
        reward,
        steps=steps,
        **options,
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss


def make_batch(*batch: int, seed: int = 0, dtype=torch.float64, observation=(1,), actions: int = 1) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*batch, *shape, generator=generator, dtype=dtype)

    ended = torch.zeros(*batch, 1, dtype=torch.bool)
    after = {"observation": draw(*observation), "reward": draw(1), "done": ended, "terminated": ended}
    return TensorDict({"observation": draw(*observation), "action": draw(actions), "next": after}, batch)


def policy_gradient(loss: SVGLoss, batch: TensorDict) -> Tensor:
    return torch.autograd.grad(loss(batch)["loss_actor"], list(loss.actor_network_params.parameters()))[0]


@pytest.mark.parametrize("gamma", [GAMMA, 0.5])
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_the_gradient_of_a_linear_quadratic_problem_is_the_one_by_hand(steps, gamma):
    """``J = -sum gamma^t (q + rho k^2) m^2t x^2 + gamma^N (w0 + w1 k + w2 k^2) m^2N x^2`` with ``m = a + b k``."""
    w0, w1, w2 = -2.0, -0.5, -0.8
    loss, batch, m = make_loss(steps, gamma=gamma), make_batch(16), A + B * K
    total = sum(gamma**t * m ** (2 * t) for t in range(steps))
    slope = sum(gamma**t * 2 * t * m ** (2 * t - 1) * B for t in range(steps))
    last, last_slope = gamma**steps * m ** (2 * steps), gamma**steps * 2 * steps * m ** (2 * steps - 1) * B
    at_end = w0 + w1 * K + w2 * K**2
    value = -(Q + RHO * K**2) * total + at_end * last
    derivative = -2 * RHO * K * total - (Q + RHO * K**2) * slope + (w1 + 2 * w2 * K) * last + at_end * last_slope
    square = batch["observation"].square().mean()
    torch.testing.assert_close(loss(batch)["loss_actor"], -value * square, rtol=1e-10, atol=0)
    torch.testing.assert_close(policy_gradient(loss, batch), (-derivative * square).view(1), rtol=1e-10, atol=0)


def test_with_the_exact_value_many_steps_give_the_gradient_of_the_return():
    loss, batch, m = make_loss(60, value=exact_value()), make_batch(4), A + B * K
    k = torch.tensor(K, dtype=torch.float64, requires_grad=True)
    x = batch["observation"]
    returns = -(Q + RHO * k**2) * x**2 / (1 - GAMMA * (A + B * k) ** 2)
    (expected,) = torch.autograd.grad(-returns.mean(), k)
    by_hand = 2 * RHO * K / (1 - GAMMA * m**2) + (Q + RHO * K**2) * 2 * GAMMA * m * B / (1 - GAMMA * m**2) ** 2
    assert float(expected) == pytest.approx(by_hand * float(x.square().mean()), rel=1e-12)
    torch.testing.assert_close(policy_gradient(loss, batch), expected.view(1), rtol=1e-10, atol=0)
    # The value itself is exact after any number of steps, its gradient is only what the steps saw.
    for steps in (0, 1, 5):
        loss = make_loss(steps, value=exact_value())
        torch.testing.assert_close(loss(batch)["loss_actor"], -returns.mean().detach(), rtol=1e-10, atol=0)


@pytest.mark.parametrize("steps", [0, 1])
def test_the_mean_gradient_of_a_gaussian_policy_is_the_one_by_hand(steps):
    """``u = k x + s e``: both weights' gradients of the expectation, within four standard errors."""
    w0, w1, w2 = value = (-2.0, -0.5, -0.8)
    x, s, m, count = 0.7, 0.3, A + B * K, 40
    at_end, slope = w0 + w1 * K + w2 * K**2, w1 + 2 * w2 * K
    if steps == 0:
        expected = torch.tensor([slope * x**2, 2 * w2 * s])
    else:
        after = m**2 * x**2 + B**2 * s**2
        by_mean = -2 * RHO * K * x**2 + GAMMA * (slope * after + at_end * 2 * m * B * x**2)
        by_scale = -2 * RHO * s + GAMMA * (at_end * 2 * B**2 * s + 2 * w2 * s)
        expected = torch.tensor([by_mean, by_scale])
    torch.manual_seed(0)
    loss, batch = make_loss(steps, scale=s, value=value), make_batch(2000)
    batch["observation"][:] = x
    found = -torch.stack([policy_gradient(loss, batch) for _ in range(count)])
    error = found.std(0) / count**0.5
    assert (error < 0.01 * expected.abs()).all() and (error > 0).all()
    assert ((found.mean(0) - expected).abs() < 4 * error).all()


def test_actions_are_drawn_in_both_losses():
    torch.manual_seed(0)
    loss, batch = make_loss(1, scale=0.3), make_batch(5)
    first, second = loss(batch.clone()), loss(batch.clone())
    assert (first["loss_actor"] != second["loss_actor"]) and (first["target_value"] != second["target_value"]).all()
    assert torch.equal(first["pred_value"], second["pred_value"])


@pytest.mark.parametrize("delay_actor", [False, True])
def test_without_steps_and_chance_it_is_ddpg(delay_actor):
    torch.manual_seed(0)
    batch = make_batch(20, observation=(3,), actions=2)
    batch["next", "terminated"][::3] = True
    policy = TensorDictModule(nn.Sequential(nn.Linear(3, 2), nn.Tanh()).double(), ["observation"], ["action"])
    value = ValueOperator(Concatenated(5), in_keys=["observation", "action"])
    outs = []
    for kind in (DDPGLoss, SVGLoss):
        options = {} if kind is DDPGLoss else {"steps": 0}
        loss = kind(policy, value, delay_actor=delay_actor, **options)
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
        HardUpdate(loss)
        out = loss(batch)
        grads = torch.autograd.grad(out["loss_actor"] + out["loss_value"], list(loss.parameters()))
        outs.append([*(out[key] for key in sorted(out.keys())), batch["td_error"], *grads])
    assert len(outs[0]) == 8 + 2 + 4
    torch.testing.assert_close(*outs, rtol=1e-12, atol=1e-14)


class Concatenated(nn.Module):
    """A small float64 network on all inputs side by side."""

    def __init__(self, inputs: int, outputs: int = 1) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, 8), nn.Tanh(), nn.Linear(8, outputs)).double()

    def forward(self, first: Tensor, *others: Tensor) -> Tensor:
        flat = first.flatten(-2) if first.shape[-1] == 13 else first
        return self.layers(torch.cat((flat, *others), dim=-1))


@pytest.fixture
def planning() -> tuple[SVGLoss, Agent]:
    """SVG(2) of a small agent with a learned model and a learned reward."""
    torch.manual_seed(0)
    sizes = {"latent": 4, "hidden": [8]}
    agent = Agent(ObservationGraph.swimmer(3), hidden=(8,), model="gn", model_options=sizes, learned_reward=True)
    observation, action = torch.randn(50, 13), torch.rand(50, 2)
    agent.update_normalizers(observation, action, observation + 0.1 * torch.randn(50, 13))
    return SVGLoss(agent.policy, agent.value, agent.model, agent.reward, steps=2), agent


def swimming(*batch: int) -> TensorDict:
    return make_batch(*batch, dtype=torch.float32, observation=(13,), actions=2)


def test_gradients_reach_only_what_a_loss_trains(planning):
    loss, agent = planning
    own = {*agent.policy.parameters(), *agent.value.parameters()}
    assert set(loss.parameters()) == own and len(own) == len(list(loss.parameters()))
    for name, trained in (("loss_actor", agent.policy), ("loss_value", agent.value)):
        agent.zero_grad(set_to_none=True)
        loss(swimming(6))[name].backward()
        reached = {weight for weight in agent.parameters() if weight.grad is not None}
        assert reached == set(trained.parameters())
        assert all(weight.grad.abs().sum() > 0 for weight in reached if weight.grad is not None)


def test_model_and_reward_are_read_as_they_are_and_left_trainable(planning):
    loss, agent = planning

    def now() -> Tensor:
        torch.manual_seed(0)
        return loss(swimming(6))["loss_actor"].detach()

    for module in (agent.model, agent.reward):
        before = now()
        assert torch.equal(now(), before)
        assert all(weight.requires_grad for weight in module.parameters())
        with torch.no_grad():
            for weight in module.parameters():
                weight += 0.1
        assert not torch.equal(now(), before)


def test_an_error_in_the_midst_of_a_loss_leaves_all_networks_whole(planning):
    loss, agent = planning
    names = {name: weight for name, weight in agent.named_parameters()}
    object.__setattr__(loss, "reward", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        loss(swimming(6))
    assert all(weight is names[name] and weight.requires_grad for name, weight in agent.named_parameters())
    assert dict(agent.named_parameters()).keys() == names.keys()


def test_a_goal_that_is_not_predicted_stays_as_it_is():
    batch = make_batch(8)
    batch["goal"], batch["next", "goal"] = batch["action"], batch["action"]
    towards = Weights(lambda w, x, goal: w[0] * (x - goal), K)
    policy = TensorDictModule(towards, ["observation", "goal"], ["action"])
    value = ValueOperator(Weights(quadratic, -2.0, -0.5, -0.8), in_keys=["observation", "action"])
    steps = make_loss(2)
    loss = SVGLoss(policy, value, steps.model, reward, steps=2)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    x, goal, expected = batch["observation"], batch["goal"], 0.0
    for step in range(2):
        u = K * (x - goal)
        expected, x = expected + GAMMA**step * reward(x, u, x), A * x + B * u
    at_end = quadratic(torch.tensor([-2.0, -0.5, -0.8], dtype=torch.float64), x, K * (x - goal))
    torch.testing.assert_close(loss(batch)["loss_actor"], -(expected + GAMMA**2 * at_end).mean(), rtol=1e-10, atol=0)


@pytest.mark.parametrize("steps", [0, 1])
def test_each_loss_alone_draws_actions_too(steps):
    loss, batch = make_loss(steps, scale=0.3), make_batch(5)
    for each in (loss.loss_actor, lambda entries: (loss.loss_value(entries)[1]["target_value"].sum(), {})):
        torch.manual_seed(0)
        first, second = each(batch)[0], each(batch)[0]
        torch.manual_seed(0)
        assert first != second and first == each(batch)[0]
    gradients = torch.autograd.grad(loss.loss_actor(batch)[0], list(loss.actor_network_params.parameters()))
    assert (gradients[0] != 0).all()  # of the scale too


def test_gamma_weighs_later_rewards():
    batch = make_batch(8)
    x, u = batch["observation"], K * batch["observation"]
    now = make_loss(1, gamma=0.0)(batch)["loss_actor"]
    torch.testing.assert_close(now, -reward(x, u, x).mean(), rtol=1e-12, atol=0)
    torch.testing.assert_close(make_loss(1)(batch)["loss_actor"] - now, -GAMMA * at_next(x).mean(), rtol=1e-10, atol=0)


def at_next(x: Tensor) -> Tensor:
    after = (A + B * K) * x
    return quadratic(torch.tensor([-2.0, -0.5, -0.8], dtype=torch.float64), after, K * after)


@pytest.mark.parametrize("steps", [0, 2])
def test_keys_and_reduction_are_ddpgs(steps):
    batch = make_batch(7)
    expected = make_loss(steps)(batch.clone())
    every = make_loss(steps, reduction="none")(batch.clone())
    for name in ("loss_actor", "loss_value"):
        assert every[name].shape == (7,)
        torch.testing.assert_close(every[name].mean(), expected[name], rtol=1e-12, atol=0)

    loss = make_loss(steps)
    loss.set_keys(reward="score", priority="surprise", done="over", terminated="failed")
    renamed = batch.rename_key_(("next", "reward"), ("next", "score"))
    renamed.rename_key_(("next", "done"), ("next", "over")).rename_key_(("next", "terminated"), ("next", "failed"))
    assert torch.equal(loss(renamed)["loss_value"], expected["loss_value"])
    assert torch.equal(renamed["surprise"], expected["td_error"])


def test_entries_may_be_given_one_by_one(planning):
    loss, batch = planning[0], swimming(7)
    named = {key if isinstance(key, str) else "_".join(key): batch.get(key, None) for key in loss.in_keys}
    torch.manual_seed(0)
    outs = loss(**{key: value for key, value in named.items() if value is not None})
    torch.manual_seed(0)
    expected = loss(batch)
    assert all(torch.equal(value, expected[key]) for key, value in zip(loss.out_keys, outs, strict=True))


@pytest.mark.parametrize("steps", [0, 2])
def test_windows_are_batches_of_their_steps(steps):
    windows = make_batch(4, 5)
    flat, shaped = make_loss(steps)(windows.reshape(-1)), make_loss(steps)(windows)
    for name in ("loss_actor", "loss_value"):
        torch.testing.assert_close(shaped[name], flat[name], rtol=1e-12, atol=0)


def test_an_empty_batch_is_refused():
    loss = make_loss(1)
    for part in (loss, loss.loss_actor, loss.loss_value):
        with pytest.raises(ValueError, match=r"SVGLoss: the batch \[0\] is empty"):
            part(make_batch(4)[:0])


def test_the_input_is_only_given_its_priority():
    batch = make_batch(5)
    before = batch.clone()
    make_loss(2)(batch)
    assert (batch.exclude("td_error") == before).all() and set(batch.keys()) == {*before.keys(), "td_error"}


def test_a_replay_buffers_batch_will_do():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), batch_size=6)
    buffer.extend(make_batch(20))
    batch = buffer.sample()
    torch.testing.assert_close(make_loss(1)(batch)["loss_actor"], make_loss(1)(batch.clone())["loss_actor"])


def test_bad_options_are_named():
    loss = make_loss(0)
    networks = loss.actor_network, loss.value_network
    with pytest.raises(ValueError, match="steps=-1 must be a whole number, 0 or more"):
        SVGLoss(*networks, steps=-1)
    for model, known in ((None, reward), (loss.model, None)):
        with pytest.raises(ValueError, match="steps=2 need a model and a reward; use steps=0 without"):
            SVGLoss(*networks, model, known, steps=2)
    bodies = TensorDictModule(lambda x, u: x, ["state", "action"], [("next", "state")])
    with pytest.raises(ValueError, match=r"predicts \[\('state',\)\], but the policy reads only .*observation"):
        SVGLoss(*networks, bodies, reward, steps=1)
    flat = SVGLoss(*networks, loss.model, lambda x, u, _: reward(x, u, _).squeeze(-1), steps=1)
    flat.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    with pytest.raises(ValueError, match=r"the reward must be \[7, 1\], .* returned \[7\]"):
        flat(make_batch(7))


@pytest.mark.parametrize("special", [False, True])
def test_it_plans_with_the_model_of_a_scene(scenes, windows, special, folds):
    """Two steps through a physics model, against the same steps written out."""
    torch.manual_seed(0)
    scene, data = scenes["pendulum"], windows["pendulum"].reshape(-1)[:30]
    model = ForwardModel.for_scene(scene, **SMALL).double().bind(scene)
    update_parameter_normalizers(model)
    update_dynamic_normalizers(model, data["state"], data["action"], data["next", "state"])
    balance = make_reward("balance", scene)
    policy = TensorDictModule(Concatenated(26), ["state"], ["action"])
    value = ValueOperator(Concatenated(27), in_keys=["state", "action"])
    planned = specialize(model) if special else model
    loss = SVGLoss(policy, value, planned, lambda x, u, after: balance(x, u, after), steps=2)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    ended = torch.zeros(30, 1, dtype=torch.bool)
    data["next"].update({"reward": torch.rand(30, 1), "done": ended, "terminated": ended})
    out = loss(data)
    if special:
        assert len(folds) == 1 and "loss_actor" in loss(data) and len(folds) == 1  # nothing has changed

    x, total = data["state"], 0.0
    for step in range(2):
        u = policy(x)
        x, before = model.step(x, u)[0], x
        total = total + GAMMA**step * balance(before, u, x)
    expected = -(total + GAMMA**2 * value(x, policy(x))).mean()
    torch.testing.assert_close(out["loss_actor"], expected, rtol=1e-9, atol=0)
    weights = list(policy.parameters())
    found, true = (torch.autograd.grad(each, weights) for each in (out["loss_actor"], expected))
    torch.testing.assert_close(found, true, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("steps", [1, 3])
def test_nothing_counts_after_an_imagined_end(steps):
    batch, bound = make_batch(64), 0.8
    loss = make_loss(steps, done=lambda x: x.squeeze(-1).abs() > bound)
    x, value, discount = batch["observation"], torch.zeros(64, 1, dtype=torch.float64), 1.0
    alive = torch.ones(64, 1, dtype=torch.float64)
    for _ in range(steps):
        value = value + discount * alive * reward(x, K * x, x)
        x, discount = (A + B * K) * x, GAMMA * discount
        alive = alive * (x.abs() <= bound)
    value = value + discount * alive * quadratic(torch.tensor([-2.0, -0.5, -0.8]), x, K * x)
    assert 0 < alive.sum() < 64
    torch.testing.assert_close(loss(batch)["loss_actor"], -value.mean(), rtol=1e-6, atol=0)
    with pytest.raises(ValueError, match=r"done= must give 'terminated', bool \[64\] or \[64, 1\], got"):
        make_loss(1, done=lambda x: x)(batch)
