"""A graph network as policy over states: its invariances, other scenes, checkpoints and learning."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_gn.dynamics import Canonicalizer, specialize
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.maths import BODY_STATE
from torchrl_gn.networks.core import UnfoldedCore
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.policies import GraphStatePolicy, StatePolicy, StateValue, task_invariances
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained, save_checkpoint

NEAR = Canonicalizer(recenter=False, yaw=True)


def states_of(scene, size: int = 16) -> Tensor:
    """Random starts, also of velocities."""
    state = SceneEnv(scene, seed=0).reset(TensorDict(batch_size=[size]))["state"]
    torch.manual_seed(0)
    state[:, 1:, 7:] += torch.randn(size, scene.num_nodes - 1, 6, dtype=state.dtype)
    return state


def make_policy(name: str, canonicalizer: Canonicalizer | None = None) -> tuple[GraphStatePolicy, Tensor]:
    scene = load_scene(name)
    torch.manual_seed(0)
    policy = GraphStatePolicy(scene, hidden=(16, 16), latent=8, canonicalizer=canonicalizer)
    state = states_of(scene)
    policy.features.update(state)
    return policy, state


def moved(state: Tensor, rotation: list[float], shift: list[float]) -> Tensor:
    """States whose bodies are rotated about the origin and then shifted."""
    by = torch.tensor(rotation, dtype=state.dtype)
    rotated = BODY_STATE.rotate(state, by.expand(len(state), 4))
    rotated[..., :3] += torch.tensor(shift, dtype=state.dtype)
    return torch.cat((state[:, :1], rotated[:, 1:]), 1)


@pytest.mark.filterwarnings("error:No complete tensor found")  # of constants that are views
@pytest.mark.parametrize("kind", [StatePolicy, pytest.param(GraphStatePolicy, marks=pytest.mark.slow)])
def test_takes_a_state_alone_and_is_exported_for_any_batch(kind, tmp_path) -> None:
    scene = load_scene("swimmer3")
    policy, state = kind(scene).requires_grad_(False), states_of(scene, 5)
    expected = policy(TensorDict({"state": state}, [5]))["action"]
    assert torch.equal(policy(state), expected) and policy(state[0]).shape == (scene.num_actions,)
    batch = torch.export.Dim("batch")
    torch.export.save(
        torch.export.export(policy, (state[:2],), dynamic_shapes=({0: batch},)), path := tmp_path / "policy.pt2"
    )
    torch.testing.assert_close(torch.export.load(path).module()(state), expected)


def test_is_as_invariant_as_the_task() -> None:
    policy, state = make_policy("swimmer6", NEAR)
    action = policy.act(state)
    assert action.std(0).min() > 1e-4
    turned = moved(state, [0.8, 0.0, 0.0, 0.6], [0.0, 0.0, 0.0])
    assert not torch.equal(turned, state)
    torch.testing.assert_close(policy.act(turned), action, rtol=1e-4, atol=1e-6)
    assert (policy.act(moved(state, [1.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.0])) - action).abs().max() > 1e-4

    policy, state = make_policy("cheetah", task_invariances(load_scene("cheetah"), lambda s, a, n, t: n[:, 1, 7:8]))
    action = policy.act(state)
    assert not policy.features.options.yaw and policy.features.options.recenter
    shifted = moved(state, [1.0, 0.0, 0.0, 0.0], [5.0, 0.0, 0.0])
    torch.testing.assert_close(policy.act(shifted), action, rtol=1e-4, atol=1e-6)
    assert (policy.act(moved(state, [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.3])) - action).abs().max() > 1e-4
    assert (policy.act(moved(state, [0.8, 0.0, 0.6, 0.0], [0.0, 0.0, 0.0])) - action).abs().max() > 1e-4


@pytest.mark.parametrize("name", ["pendulum", "acrobot", "cartpole", "swimmer3", "walker2d", "jaco"])
def test_every_system_within_its_bounds(name: str) -> None:
    policy, state = make_policy(name)
    action, density = policy.sample(state)
    low, high = (torch.as_tensor(bound).float() for bound in (policy.scene.action_low, policy.scene.action_high))
    assert action.shape == (16, policy.scene.num_actions) and density.shape == (16,)
    assert bool((action >= low).all() and (action <= high).all() and density.isfinite().all())
    expected = policy.act(state).detach()
    with torch.no_grad():  # also of a pendulum, whose graph has no edges
        torch.testing.assert_close(policy.act(state), expected)


def test_equals_message_passing() -> None:
    policy, state = make_policy("swimmer3", NEAR)
    static = policy.features.static_graph(policy.log_std)
    plain = UnfoldedCore(policy.network, static).predict(policy.features(state, torch.float32))
    torch.testing.assert_close(policy.unbounded(state), plain[:, 1:, 0], rtol=1e-4, atol=1e-6)


def test_prepared_weights_act_and_learn_as_others(folds) -> None:
    policy, state = make_policy("swimmer3", NEAR)
    weights = list(policy.network.parameters())

    def act() -> list[Tensor]:
        total = policy.act(state).sum() + policy.act(2 * state).square().sum()
        return [total.detach(), *torch.autograd.grad(total, weights)]

    expected = act()
    assert len(folds) == 2
    with policy.prepared():
        found = act()
    assert len(folds) == 3
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    with torch.no_grad():
        weights[-1] += 1
    assert not torch.equal(act()[0], expected[0])


def test_drives_other_scenes_with_the_same_weights(tmp_path) -> None:
    policy, _ = make_policy("swimmer3", NEAR)
    longer = policy.for_scene(load_scene("swimmer6"))
    assert {id(weight) for weight in longer.parameters()} == {id(weight) for weight in policy.parameters()}
    state = states_of(longer.scene)
    before = longer.act(state)
    assert before.shape == (16, 5)
    with torch.no_grad():
        policy.network.second.node_mlp[-1].bias += 1
    assert bool((longer.act(state) > before).all())
    longer.features.update(state + 1)
    assert torch.equal(policy.features.node_normalizer.mean, longer.features.node_normalizer.mean)

    save_checkpoint(tmp_path / "policy.safetensors", longer)
    read = load_pretrained(tmp_path / "policy.safetensors").policy
    assert isinstance(read, GraphStatePolicy) and torch.equal(read.act(state), longer.act(state))
    back = read.for_scene(load_scene("swimmer3"))
    assert torch.equal(back.act(states_of(back.scene)), policy.act(states_of(back.scene)))


SLIDING = """<mujoco><worldbody><body name="a" pos="0 0 1">{}<joint name="z" axis="0 0 1"/><geom size=".1"/>
  <body name="b" pos=".3 0 0"><joint name="k" axis="0 0 1"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/></body></body></worldbody>
  <actuator><motor joint="k" ctrlrange="-{} {}"/></actuator></mujoco>"""


def sliding(axes: str, bound: float = 1.0):
    numbers = {"x": "1 0 0", "y": "0 1 0"}
    joints = "".join(f'<joint name="{axis}" type="slide" axis="{numbers[axis]}"/>' for axis in axes)
    return load_scene(SLIDING.format(joints, bound, bound))


def test_refuses_scenes_of_other_invariances() -> None:
    policy = GraphStatePolicy(sliding("xy"), canonicalizer=Canonicalizer(recenter=True, yaw=False))
    with pytest.raises(ValueError, match="has invariant axes x, not xy"):
        policy.for_scene(sliding("x"))
    policy = GraphStatePolicy(sliding("xy"), canonicalizer=Canonicalizer(recenter=False, yaw=False))
    assert policy.for_scene(sliding("x")).features.size == policy.features.size  # which sees all positions


def test_policies_of_a_scene_keep_within_its_bounds() -> None:
    policy = StatePolicy(sliding("xy", 2.0), hidden=[8])
    with pytest.raises(ValueError, match="action 'actuator0' is within -2 and 2, beyond the -1 and 1 of scene"):
        policy.for_scene(sliding("xy", 1.0))
    assert policy.for_scene(sliding("xy", 3.0)) is policy
    assert GraphStatePolicy(policy.scene).for_scene(sliding("xy", 1.0)).half_range.tolist() == [1.0]


@pytest.mark.slow
def test_several_scenes_learn_at_once() -> None:
    policy, _ = make_policy("swimmer3", NEAR)
    gradients = []
    for name in ("swimmer3", "swimmer6"):
        scene = load_scene(name)
        model = load_pretrained("swimmerN" if name == "swimmer3" else "swimmer6").model
        env = ModelEnv(specialize(model.bind(scene)), make_reward("near", scene))
        value = StateValue(scene, hidden=(8,), canonicalizer=NEAR)
        loss = SHACLoss(policy.for_scene(scene), value, env, steps=3)
        loss.fit_normalizers(states_of(scene), torch.rand(100, 1))
        loss(TensorDict({"state": states_of(scene)}, [16]))["loss_actor"].backward()
        gradients.append([weight.grad.clone() for weight in policy.parameters()])
    assert all(bool((gradient != 0).any()) for gradient in gradients[0])
    assert all(not torch.equal(one, both) for one, both in zip(*gradients, strict=True))


def test_explores_as_torchrl_says() -> None:
    policy, state = make_policy("swimmer3", NEAR)
    now = TensorDict({"state": state}, [16])
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(policy(now.copy())["action"], policy(now.copy())["action"])
    assert torch.equal(policy(now.copy())["action"], policy.act(state))


def test_refuses_what_does_not_fit() -> None:
    policy, state = make_policy("swimmer3", NEAR)
    with pytest.raises(ValueError, match=r"States of 'swimmer3' must be"):
        policy.act(state[:, 1:])
    with pytest.raises(ValueError, match="features have other sizes"):
        policy.for_scene(load_scene("cheetah"))
    with pytest.raises(ValueError, match=r"The policy learned with control steps of .* load it with timestep="):
        policy.for_scene(load_scene("swimmer6", timestep=0.1))
    with pytest.raises(ValueError, match="hidden="):
        GraphStatePolicy(policy.scene, hidden=())
