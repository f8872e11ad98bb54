"""The short-horizon actor-critic against its definition, and learning in a pretrained model."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal

from torchrl_gn.dynamics import Ensemble, specialize
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.policies import StatePolicy, StateValue
from torchrl_gn.rewards import Distance, make_reward
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained


@pytest.fixture(scope="module")
def model():
    return load_pretrained("pendulum").model


@pytest.fixture(scope="module")
def starts(scenes) -> Tensor:
    return SceneEnv(scenes["pendulum"], seed=0).reset(TensorDict(batch_size=[32]))["state"]


def make_loss(model, scene, starts: Tensor, *, native: bool = True, reward=None, **options) -> SHACLoss:
    torch.manual_seed(0)
    bound = model.bind(scene)
    env = ModelEnv(specialize(bound) if native else bound, reward or make_reward("balance", scene))
    policy, value = StatePolicy(scene, hidden=(16,)), StateValue(scene, discount=0.9, hidden=(16,))
    loss = SHACLoss(policy, value, env, **options)
    spread = starts + 0.3 * torch.randn(starts.shape, dtype=starts.dtype)
    loss.fit_normalizers(spread, -3 * torch.rand(100, 1))
    return loss


def played(loss: SHACLoss, entries: TensorDict, steps: int, env: ModelEnv | None = None) -> TensorDict:
    """Control steps ``[B, H]`` of the policy in the model, with the actions' log densities, after seed 1."""
    env, done = loss.env if env is None else env, []
    now = env.reset(entries.clone(), set_state=True)
    torch.manual_seed(1)
    with torch.no_grad():
        for _ in range(steps):
            action, density = loss.policy.sample(now["state"])
            after = env.step(now.set("action", action))["next"]
            step = {"state": now["state"], "action": action, "density": density, "next": after}
            done.append(TensorDict(step, now.batch_size))
            now = now.update(after.exclude("reward"))
    return torch.stack(done, 1)


def test_it_says_what_it_reads_and_writes_as_every_loss(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts)
    out = loss(TensorDict({"state": starts}, [32]))
    assert loss.in_keys == ["state"] and set(loss.out_keys) == set(out.keys())
    assert repr(loss).startswith("SHACLoss(")


def test_losses_are_those_of_the_definition(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts, steps=4, lmbda=0.7)
    torch.manual_seed(1)
    out = loss(TensorDict({"state": starts}, [32]))
    torch.manual_seed(1)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        start = loss.env.reset(TensorDict({"state": starts}, [32]), set_state=True)
        played = loss.env.rollout(4, loss.policy, tensordict=start, auto_reset=False)
        reward, value = played["next", "reward"], loss.value
        total = sum(0.9**k * reward[:, k] for k in range(4)) + 0.9**4 * value(played["next", "state"][:, -1])
        wanted = -(total / value.normalizer.std).mean() - loss.log_alpha.exp() * out["entropy"]
        torch.testing.assert_close(out["loss_actor"].detach().double(), wanted.double(), rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(out["reward"], reward.mean())
        surplus = out["entropy"] + 1  # over the target: minus one action
        torch.testing.assert_close(out["loss_alpha"].detach(), loss.log_alpha.exp() * surplus)
        target, targets = value(played["next", "state"][:, -1]), []
        for k in reversed(range(4)):
            after = value(played["next", "state"][:, k])
            target = reward[:, k] + 0.9 * (after if k == 3 else 0.3 * after + 0.7 * target)
            targets.append(value.normalizer(target.float()))
        predicted = value.normalized(value.features(played["state"], torch.float32))
        error = (predicted - torch.stack(targets[::-1], 1)).square().mean()
        torch.testing.assert_close(out["loss_value"].detach(), error, rtol=1e-4, atol=1e-6)


def test_the_gradient_is_the_plain_models(model, scenes, starts):
    found = []
    for native in (True, False):
        loss = make_loss(model, scenes["pendulum"], starts, native=native, steps=5)
        torch.manual_seed(1)
        loss(TensorDict({"state": starts}, [32]))["loss_actor"].backward()
        found.append([weight.grad.clone() for weight in loss.policy.parameters()])
    assert all(bool((gradient != 0).any()) for gradient in found[0])
    for native, plain in zip(*found, strict=True):
        torch.testing.assert_close(native, plain, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_every_action_maximises_the_return_of_its_own_step(model, scenes, starts, share):
    loss = make_loss(model, scenes["pendulum"], starts, native=False, steps=4, policy_lmbda=share, outlier=math.inf)
    loss.log_alpha.data.fill_(-30)
    found = gradient_of(loss, starts)
    torch.manual_seed(1)
    noise = [torch.randn(32, 1) for _ in range(4)]
    policy, value, reward = loss.policy, loss.value, loss.env.reward
    later = copy.deepcopy(policy).requires_grad_(False)
    step, state, total = model.bind(scenes["pendulum"]), starts, torch.zeros(())
    for k in range(4):
        states, rewards = [state.detach()], []
        for index in range(k, 4):
            action, _ = (policy if index == k else later).sample(states[-1], noise=noise[index])
            states.append(step(states[-1], action))
            rewards.append(reward(states[-2], action, states[-1], None))
        returns = value(states[-1])
        for paid, reached in zip(reversed(rewards), reversed(states[1:]), strict=True):
            returns = paid + 0.9 * ((1 - share) * value(reached) + share * returns)
        total = total - (returns / value.normalizer.std).mean()
        state = states[1]
    weights = list(policy.network.parameters())
    wanted = torch.cat([each.flatten() for each in torch.autograd.grad(total, weights)])
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-6)


def test_the_value_learns_on_from_what_was_imagined(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts, steps=4)
    out = loss(TensorDict({"state": starts}, [32]))
    imagined = out["imagined"].flatten()
    assert imagined.shape == (128,) and not any(each.requires_grad for each in imagined.values())
    torch.testing.assert_close(loss.value_loss(imagined), out["loss_value"])
    adam = torch.optim.Adam(loss.value.parameters(), lr=1e-2)
    for _ in range(20):
        adam.zero_grad()
        loss.value_loss(imagined[torch.randint(128, (64,))]).backward()
        adam.step()
    assert loss.value_loss(imagined) < 0.5 * out["loss_value"]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_a_copy_learns_from_its_own_value(model, scenes, starts, copied):
    loss = make_loss(model, scenes["pendulum"], starts)
    other, batch = copied(loss), TensorDict({"state": starts}, [32])
    with torch.no_grad():
        for weight in other.value.parameters():
            weight.mul_(1.5)
    fresh = SHACLoss(other.policy, other.value, other.env, steps=other.steps)
    found = []
    for each in (other, fresh, loss):
        torch.manual_seed(0)
        found.append(each(batch)["imagined"]["target"])
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])


def test_each_loss_reaches_its_own_weights(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts, native=False, steps=3)
    weights = {"actor": loss.policy, "value": loss.value.members, "alpha": nn.ParameterList([loss.log_alpha])}
    assert {id(weight) for weight in loss.parameters()} == {id(w) for of in weights.values() for w in of.parameters()}
    for name in weights:
        loss.zero_grad()
        loss(TensorDict({"state": starts}, [32]))[f"loss_{name}"].backward()
        for other, network in weights.items():
            reached = [weight.grad is not None and bool((weight.grad != 0).any()) for weight in network.parameters()]
            assert all(reached) if other == name else not any(reached), (name, other)
    assert all(weight.grad is None for weight in model.parameters())


@pytest.mark.parametrize("frozen", ["policy", "value", "log_alpha"])
def test_a_frozen_part_changes_nothing_for_the_others(model, scenes, starts, frozen):
    loss, batch = make_loss(model, scenes["pendulum"], starts, steps=3), TensorDict({"state": starts}, [32])

    def learned() -> tuple[TensorDict, dict[str, Tensor]]:
        loss.zero_grad()
        torch.manual_seed(1)
        out = loss(batch)
        sum(out[name] for name in ("loss_actor", "loss_value", "loss_alpha")).backward()
        return out.detach(), {name: w.grad.clone() for name, w in loss.named_parameters() if w.grad is not None}

    wanted, gradients = learned()
    getattr(loss, frozen).requires_grad_(False)
    got, others = learned()
    torch.testing.assert_close(dict(got), dict(wanted), rtol=0, atol=0)
    torch.testing.assert_close(others, {name: g for name, g in gradients.items() if not name.startswith(frozen)})
    assert others
    torch.manual_seed(1)
    with torch.no_grad():
        torch.testing.assert_close(dict(loss(batch)), dict(wanted), rtol=0, atol=0)


@pytest.mark.parametrize("pessimism", [0.0, 1.5])
def test_an_ensemble_gives_a_lower_bound_of_the_members_returns(scenes, make_model, starts, pessimism):
    scene = scenes["pendulum"]
    models = [make_model(scene, seed=seed) for seed in range(3)]
    loss = make_loss(Ensemble(models), scene, starts, pessimism=pessimism, steps=3, native=False)
    value, batch = loss.value, TensorDict({"state": starts}, [32])
    envs = [ModelEnv(model.bind(scene), loss.env.reward) for model in models]
    each = torch.stack([played(loss, batch, 3, env) for env in envs])  # with the same noise
    total = sum(0.9**k * each["next", "reward"][:, :, k] for k in range(3)).squeeze(-1)
    total = total + 0.9**3 * value(each["next", "state"][:, :, -1]).squeeze(-1)
    bound = total.mean(0) - pessimism * total.std(0)
    torch.manual_seed(1)
    out = loss(batch)
    features = value.features(each["state"].flatten(0, 1), torch.float32)
    torch.testing.assert_close(out["imagined"]["features"], features, rtol=1e-4, atol=1e-5)
    wanted = -(bound / value.normalizer.std).mean() - loss.log_alpha.exp() * out["entropy"]
    torch.testing.assert_close(out["loss_actor"].double(), wanted.double(), rtol=1e-5, atol=1e-6)
    (out["loss_actor"] + out["loss_value"]).backward()
    assert all(bool((weight.grad != 0).any()) for weight in loss.policy.network.parameters())


class Diverging(nn.Module):
    """A model that overflows for every second sample."""

    in_keys, out_keys = ["state", "action"], [("next", "state")]

    def __init__(self, scene) -> None:
        super().__init__()
        self.scene = scene

    def forward(self, tensordict):
        state, action = tensordict["state"], tensordict["action"]
        factor = torch.where(torch.arange(len(state)) % 2 == 0, 1.0, math.inf)[:, None, None]
        return tensordict.set(("next", "state"), state + 1e-3 * factor * action.double().sum(-1)[:, None, None])


def test_what_diverges_ends_and_spoils_nothing(scenes, starts):
    scene = scenes["pendulum"]
    torch.manual_seed(0)
    policy, value = StatePolicy(scene, hidden=(16,)), StateValue(scene, discount=0.9, hidden=(16,))
    env = ModelEnv(Diverging(scene), make_reward("balance", scene))
    loss = SHACLoss(policy, value, env, steps=3)
    loss.fit_normalizers(starts + torch.randn(starts.shape, dtype=starts.dtype), -torch.rand(100, 1))
    out = loss(TensorDict({"state": starts}, [32]))
    (out["loss_actor"] + out["loss_value"]).backward()
    assert out["reward"] > -1000 and env.unstable_reward == -1e6  # what a learner bears, unlike a planner
    gradients = [weight.grad for weight in loss.parameters() if weight.grad is not None]
    assert gradients and all(bool(gradient.isfinite().all()) for gradient in gradients)
    assert any(bool((weight.grad != 0).any()) for weight in policy.network.parameters())


@pytest.mark.slow
def test_a_policy_learns_to_swing(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts, steps=16)
    adam = torch.optim.Adam(loss.parameters(), lr=1e-2)
    rewards = []
    for _ in range(100):
        out = loss(TensorDict({"state": starts}, [32]))
        adam.zero_grad()
        (out["loss_actor"] + out["loss_value"] + out["loss_alpha"]).backward()
        adam.step()
        for _ in range(8):  # else the value does not keep up with the policy
            adam.zero_grad()
            loss.value_loss(out["imagined"]).backward()
            adam.step()
        rewards.append(float(out["reward"]))
    assert sum(rewards[-5:]) / 5 > sum(rewards[:5]) / 5 + 0.02


def test_samples_have_the_density_of_a_bounded_normal(scenes, starts):
    policy = StatePolicy(scenes["pendulum"], hidden=(16,))
    policy.features.fit(starts + torch.randn(starts.shape, dtype=starts.dtype))
    action, density = policy.sample(starts)
    before = policy.network(policy.features(starts, torch.float32))
    normal = TanhNormal(before, policy.log_std.exp(), upscale=1.0, tanh_loc=False)
    scaled = (action - policy.middle) / policy.half_range
    torch.testing.assert_close(density, normal.log_prob(scaled), rtol=1e-3, atol=1e-3)
    noise = torch.randn(action.shape)
    given, density = policy.sample(starts, noise=noise)
    scaled = (given - policy.middle) / policy.half_range
    torch.testing.assert_close(scaled, (before + policy.log_std.exp() * noise).tanh())
    torch.testing.assert_close(density, normal.log_prob(scaled), rtol=1e-3, atol=1e-3)
    now = TensorDict({"state": starts}, [32])
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(policy(now.copy())["action"], policy(now.copy())["action"])
    assert torch.equal(policy(now.copy())["action"], policy.act(starts))


def test_refuses_what_does_not_fit(model, scenes, starts):
    scene = scenes["pendulum"]
    loss = make_loss(model, scene, starts)
    with pytest.raises(ValueError, match="steps=0 must be"):
        SHACLoss(loss.policy, loss.value, loss.env, steps=0)
    with pytest.raises(ValueError, match=r"lmbda=2\.0 must be"):
        SHACLoss(loss.policy, loss.value, loss.env, lmbda=2.0)
    with pytest.raises(ValueError, match=r"policy_lmbda=-0\.1 must be"):
        SHACLoss(loss.policy, loss.value, loss.env, policy_lmbda=-0.1)
    with pytest.raises(ValueError, match="leave its terminal= out"):
        SHACLoss(loss.policy, loss.value, ModelEnv(loss.env.world_model, loss.env.reward, terminal=loss.value))
    with pytest.raises(ValueError, match="StatePolicy is of scene 'cartpole', whose bodies are not those"):
        SHACLoss(StatePolicy(load_scene("cartpole")), loss.value, loss.env)
    with pytest.raises(ValueError, match=r"pessimism=1\.0 needs an ensemble"):
        SHACLoss(loss.policy, loss.value, loss.env, pessimism=1.0)
    with pytest.raises(RuntimeError, match="call fit_normalizers first"):
        SHACLoss(StatePolicy(scene), loss.value, loss.env)(TensorDict({"state": starts}, [32]))
    with pytest.raises(KeyError, match="needs 'state'"):
        loss(TensorDict({"observation": starts}, [32]))
    with pytest.raises(ValueError, match="'state' of the batch"):
        loss(TensorDict({"state": starts * math.nan}, [32]))
    with pytest.raises(ValueError, match=r"the batch \[0\] is empty"):
        loss(TensorDict({"state": starts[:0]}, [0]))


def test_collected_rows_are_a_batch_of_their_states(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts)
    found = []
    for batch in ([32], [4, 8], [2, 4, 4]):
        torch.manual_seed(1)
        found.append(loss(TensorDict({"state": starts.reshape(*batch, *starts.shape[1:])}, batch)))
        assert found[-1]["imagined"].shape == (32, 5)
        assert torch.equal(found[-1]["loss_actor"], found[0]["loss_actor"])


@pytest.mark.parametrize("what", ["parameters", "hidden_state"])
def test_imagination_starts_from_all_that_the_model_reads(scenes, make_model, starts, what):
    """Of other samples in the batch it would be another imagination."""
    scene = scenes["pendulum"]
    reads = what == "parameters"
    bound = make_model(scene, core="gn" if reads else "recurrent").bind(scene, parameters_key=what if reads else None)
    env = ModelEnv(bound, make_reward("balance", scene))
    loss = SHACLoss(StatePolicy(scene, hidden=(8,)), StateValue(scene, discount=0.9, hidden=(8,)), env, steps=3)
    loss.fit_normalizers(starts + 0.3 * torch.randn_like(starts), -torch.rand(9, 1))
    own = bound.own_parameters() if reads else bound.initial_hidden_state()
    torch.manual_seed(1)
    entry = own.expand(32).apply(lambda value: value + 0.3 * torch.randn_like(value))
    batch = TensorDict({"state": starts, what: entry}, [32])

    def features(batch) -> Tensor:
        torch.manual_seed(1)
        return loss(batch)["imagined"]["features"]

    found, wanted = features(batch), loss.value.features(played(loss, batch, 3, env)["state"], torch.float32)
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)
    assert (features(batch.exclude(what)) - found).abs().flatten(1).amax(1).gt(1e-5).all()
    torch.testing.assert_close(features(batch.reshape(4, 8)), found, rtol=0, atol=0)


def test_samples_of_other_variants_are_refused(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts)
    own = model.bind(scenes["pendulum"], parameters_key="parameters").own_parameters()
    loss(TensorDict({"state": starts, "parameters": own.expand(32)}, [32]))
    with pytest.raises(ValueError, match="other parameters 'nodes' than scene 'pendulum'"):
        loss(TensorDict({"state": starts, "parameters": own.apply(lambda value: value + 1).expand(32)}, [32]))


def test_done_reads_entries_of_the_batch(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts)
    loss.env.ends = TensorDictModule(lambda _, over: over, ["state", "over"], ["terminated"])
    over = torch.arange(32) % 2 == 0
    counted = loss(TensorDict({"state": starts, "over": over}, [32]))["imagined"]["weight"].squeeze(-1)
    assert counted[:, 0].all() and torch.equal(counted[:, 1:] == 0, over[:, None].expand(32, 4))


def test_nothing_counts_after_an_end(model, scenes, starts):
    loss = make_loss(model, scenes["pendulum"], starts, steps=4)
    loss.env.ends = lambda state: state[..., 1, 11].abs() > 0.5
    torch.manual_seed(1)
    out = loss(TensorDict({"state": starts}, [32]))
    count, total, entropy, returns = 0, 0.0, 0.0, []
    with torch.no_grad():
        for row in played(loss, TensorDict({"state": starts}, [32]), 4).unbind(0):
            counted, alive = 0.0, True
            for k, step in enumerate(row.unbind(0)):
                if alive:
                    reward = step["next", "reward"].item()
                    count, total, entropy = count + 1, total + reward, entropy - step["density"].item()
                    counted, alive = counted + 0.9**k * reward, not step["next", "terminated"].item()
            last = float(loss.value(row["next", "state"][-1])) if alive else 0.0
            returns.append(counted + 0.9**4 * last)
        assert 32 < count < 4 * 32
        assert out["reward"].item() == pytest.approx(total / count, rel=1e-4)
        assert out["entropy"].item() == pytest.approx(entropy / count, rel=1e-4)
        mean = sum(returns) / len(returns) / loss.value.normalizer.std.item()
        wanted = -mean - loss.log_alpha.exp().item() * entropy / count
    assert out["loss_actor"].item() == pytest.approx(wanted, rel=1e-4)


def targeted_loss(model, scene, starts: Tensor, target: Tensor, **options) -> SHACLoss:
    torch.manual_seed(0)
    env = ModelEnv(specialize(model.bind(scene)), Distance(scene, "pole", offset=(0.0, 0.0, 0.5)))
    policy = StatePolicy(scene, hidden=(16,), target=True)
    value = StateValue(scene, discount=0.9, hidden=(16,), target=True)
    loss = SHACLoss(policy, value, env, **options)
    spread = starts + 0.3 * torch.randn(starts.shape, dtype=starts.dtype)
    loss.fit_normalizers(spread, -3 * torch.rand(100, 1), target)
    return loss


def test_episodes_may_have_a_target(model, scenes, starts):
    target = torch.randn(len(starts), 3, generator=torch.Generator().manual_seed(0)).double()
    loss = targeted_loss(model, scenes["pendulum"], starts, target, steps=4)
    batch = TensorDict({"state": starts, "target": target}, [len(starts)])
    torch.manual_seed(1)
    out = loss(batch)
    torch.manual_seed(1)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        start = loss.env.reset(batch.select("state"), set_state=True).set("target", target).set("task", target)
        played = loss.env.rollout(4, loss.policy, tensordict=start, auto_reset=False)
        reward, last = played["next", "reward"], loss.value(played["next", "state"][:, -1], target)
    total = sum(0.9**k * reward[:, k] for k in range(4)) + 0.9**4 * last
    wanted = -(total / loss.value.normalizer.std).mean() - loss.log_alpha.exp() * out["entropy"]
    torch.testing.assert_close(out["loss_actor"].detach().double(), wanted.detach().double(), rtol=1e-5, atol=1e-6)
    elsewhere = loss(batch.clone().set("target", target.flip(0)))
    assert abs(float((elsewhere["loss_value"] - out["loss_value"]).detach())) > 1e-4
    (out["loss_actor"] + out["loss_value"]).backward()
    assert all(each.grad is not None for each in (*loss.policy.parameters(), *loss.value.parameters()))
    with pytest.raises(KeyError, match="SHACLoss needs 'target'"):
        loss(batch.select("state"))


def test_actions_are_repeated_in_the_model(model, scenes, starts):
    scene, coarse = scenes["pendulum"], load_scene("pendulum", timestep=3 * scenes["pendulum"].timestep)
    torch.manual_seed(0)
    specialized, reward = specialize(model.bind(scene)), make_reward("balance", scene)
    env = ModelEnv(specialized, reward)
    policy, value = StatePolicy(coarse, hidden=(16,)), StateValue(coarse, discount=0.9, hidden=(16,))
    loss = SHACLoss(policy, value, ModelEnv(specialized, reward, action_repeat=3), steps=2, lmbda=1.0)
    loss.fit_normalizers(starts + 0.3 * torch.randn(starts.shape, dtype=starts.dtype), -3 * torch.rand(100, 1))
    batch = TensorDict({"state": starts}, [len(starts)])
    torch.manual_seed(1)
    out = loss(batch)
    torch.manual_seed(1)
    with torch.no_grad():
        now, total, paid = env.reset(batch, set_state=True), 0.0, []
        for k in range(2):
            action = policy.sample(now["state"])[0]
            paid.append(0.0)
            for _ in range(3):
                after = env.step(now.set("action", action))["next"]
                paid[k] = paid[k] + after["reward"]
                now = after.select("state")
            total = total + 0.9**k * paid[k]
        last = value(now["state"])
        wanted = -((total + 0.9**2 * last) / value.normalizer.std).mean()
        wanted = wanted - loss.log_alpha.exp() * out["entropy"]
        targets = [total + 0.9**2 * last, paid[1] + 0.9 * last]
    torch.testing.assert_close(out["loss_actor"].detach().double(), wanted.double(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(out["reward"], torch.cat(paid).mean())
    targets = torch.stack([value.normalizer(each.float()) for each in targets], 1)
    torch.testing.assert_close(out["imagined"]["target"], targets, rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="StatePolicy learned with control steps of 60 ms, scene 'pendulum' has 40 ms"):
        SHACLoss(policy, value, ModelEnv(specialized, reward, action_repeat=2))


def test_policy_value_and_reward_share_the_target(model, scenes, starts):
    scene = scenes["pendulum"]
    loss = targeted_loss(model, scene, starts, torch.zeros(len(starts), 3).double(), steps=2)
    plain = ModelEnv(model.bind(scene), make_reward("balance", scene))
    for policy, value, env in (
        (loss.policy, loss.value, plain),
        (StatePolicy(scene), loss.value, loss.env),
        (loss.policy, StateValue(scene), loss.env),
    ):
        with pytest.raises(ValueError, match="must all have a target, or none"):
            SHACLoss(policy, value, env)


def scaled_speed(count: int, value: float):
    """Scales ``[count, 1, 1]``, and a reward of so many times the pole's speed."""
    scale = torch.full((count, 1, 1), value).double()
    return scale, lambda state, action, after, task: scale * after[..., 1, 11:12]


def gradient_of(loss: SHACLoss, starts: Tensor) -> Tensor:
    loss.zero_grad()
    torch.manual_seed(1)
    loss(TensorDict({"state": starts}, [len(starts)]))["loss_actor"].backward()
    return torch.cat([weight.grad.flatten() for weight in loss.policy.network.parameters()])


def test_one_trajectory_does_not_make_the_gradient_of_a_batch(model, scenes, starts):
    scale, reward = scaled_speed(len(starts), 1.0)
    options = {"reward": reward, "steps": 4}
    losses = {
        limit: make_loss(model, scenes["pendulum"], starts, outlier=limit, **options) for limit in (2.0, math.inf)
    }
    found: dict[float, list[Tensor]] = {}
    for limit, loss in losses.items():
        loss.log_alpha.data.fill_(-30)
        for weight in (1.0, 1e3, 1e6):
            scale[0] = weight
            found.setdefault(limit, []).append(gradient_of(loss, starts))
    torch.testing.assert_close(found[2.0][1], found[2.0][2], rtol=1e-3, atol=1e-6)
    assert found[2.0][1].norm() < 1.5 * found[2.0][0].norm()
    assert found[math.inf][1].norm() > 10 * found[math.inf][0].norm()
    scale[0] = 1.0
    losses[math.inf].outlier = 1e9
    torch.testing.assert_close(gradient_of(losses[math.inf], starts), found[math.inf][0])


def test_trajectories_without_a_gradient_do_not_silence_the_others(model, scenes, starts):
    scale, reward = scaled_speed(len(starts), 0.0)
    loss = make_loss(model, scenes["pendulum"], starts, reward=reward, steps=3, outlier=1.0)
    loss.log_alpha.data.fill_(-30)
    scale[:5] = 1.0  # of 32: the median is 0
    with torch.no_grad():
        for member in loss.value.members:
            for weight in member.parameters():
                weight.zero_()
    assert gradient_of(loss, starts).norm() > 1e-5
    scale.zero_()
    assert gradient_of(loss, starts).norm() < 1e-10  # of the entropy
    with pytest.raises(ValueError, match="outlier=0"):
        make_loss(model, scenes["pendulum"], starts, outlier=0)
