"""ModelEnv: gradients, and agreement with the true environment."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from torchrl_gn.dynamics import Ensemble, ForwardModel
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.envs import ModelEnv, SceneEnv, batched
from torchrl_gn.envs.specs import reward_of
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import PhysicalParameters, load_scene

from ..sizes import SMALL


def rollout(env: ModelEnv, start: TensorDict, actions: torch.Tensor) -> TensorDict:
    """Steps with given actions ``[*B, T, A]``."""
    moves = iter(actions.unbind(-2))
    return env.rollout(
        actions.shape[-2],
        lambda td: td.set("action", next(moves)),
        tensordict=start,
        auto_reset=False,
        break_when_any_done=False,
    )


def test_specs_are_those_of_the_true_environment(scene_env, model_env):
    for name in ("action_spec", "reward_spec", "done_spec"):
        assert getattr(model_env, name) == getattr(scene_env, name)
    assert model_env.observation_spec["state"] == scene_env.observation_spec["state"]
    assert model_env.batch_size == scene_env.batch_size == torch.Size([])
    assert not model_env.batch_locked


def test_steps_are_the_models(model_env):
    start = model_env.rand_action(model_env.reset(TensorDict(batch_size=[2, 3])))
    before = start.clone()
    stepped = model_env.step(start)
    expected = model_env.world_model(before.clone())["next", "state"]
    assert torch.equal(stepped["next", "state"], expected)
    assert (stepped.exclude("next") == before).all()


def test_an_ensemble_steps_by_its_mean_without_calibration(pendulum):
    torch.manual_seed(0)
    ensemble = Ensemble.for_scene(pendulum, count=2, **SMALL).bind(pendulum)
    env = ModelEnv(ensemble, make_reward("balance", pendulum), seed=0)
    start, actions = env.reset(TensorDict(batch_size=[3])), torch.rand(3, 4, 1) - 0.5
    played = rollout(env, start.clone(), actions)
    states, rewards = env.imagine(start, actions)
    torch.testing.assert_close(played["next", "state"], states[:, 1:], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(played["next", "reward"], rewards, rtol=1e-5, atol=1e-6)


def test_gradient_of_the_return_is_the_finite_difference(model_env):
    start = model_env.reset(TensorDict(batch_size=[2]))
    # The state's own sum, in float64: rewards are float32.
    weights = torch.randn(2, 4, model_env.scene.num_nodes, 13, dtype=torch.float64)

    def total(actions: torch.Tensor) -> torch.Tensor:
        return (weights * rollout(model_env.double(), start.clone(), actions)["next", "state"]).sum()

    actions = torch.randn(2, 4, 1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(total, (actions,))


def test_reward_gradients_reach_actions_states_and_weights(model_env):
    start = model_env.reset(TensorDict(batch_size=[2]))
    start["state"].requires_grad_()
    actions = torch.full((2, 3, 1), 0.1, requires_grad=True)
    state = start["state"]
    rollout(model_env, start, actions)["next", "reward"].square().sum().backward()
    for gradient in (actions.grad, state.grad, model_env.world_model.gain.grad):
        assert gradient.isfinite().all()
        assert (gradient != 0).any()


def test_starts_are_true_starts_observed(pendulum, model_env):
    true = SceneEnv(pendulum, seed=5).reset(TensorDict(batch_size=[4]))
    model_env.set_seed(5)
    assert torch.equal(model_env.reset(TensorDict(batch_size=[4]))["state"], true["state"])


def test_reset_starts_from_a_given_state_when_asked(scene_env, model_env):
    true = scene_env.reset(TensorDict(batch_size=[4]))
    kept = model_env.reset(true.clone(), set_state=True)
    assert torch.equal(kept["state"], true["state"])
    model_env.set_seed(1)
    drawn = model_env.reset(true.clone(), set_state=False)
    assert not torch.equal(drawn["state"], true["state"])


def test_a_prediction_that_is_not_finite_is_flagged_and_held(model_env):
    start = model_env.reset(TensorDict(batch_size=[3]))
    start["action"] = torch.tensor([[0.5], [torch.nan], [0.5]])
    after = model_env.step(start)["next"]
    assert after["terminated"].flatten().tolist() == [False, True, False]
    assert torch.equal(after["done"], after["terminated"])
    assert torch.equal(after["state"][1], start["state"][1])
    assert after["reward"][1].item() == -1e6
    assert after["state"].isfinite().all()


def test_the_weights_are_the_environments_and_follow_it(model_env):
    assert {name for name, _ in model_env.named_parameters()} == {"world_model.gain", "world_model.drift"}
    assert {p.dtype for p in model_env.double().parameters()} == {torch.float64}


def test_a_reward_may_serve_environments_on_several_devices(pendulum):
    reward = make_reward("balance", pendulum)
    here, elsewhere = (SimpleNamespace(device=torch.device(name)) for name in ("cpu", "meta"))
    moved = cast(nn.Module, reward_of(reward, cast(EnvBase, elsewhere), pendulum))
    assert {buffer.device.type for buffer in moved.buffers()} == {"meta"}
    assert reward_of(reward, cast(EnvBase, here), pendulum) is reward
    assert {buffer.device.type for buffer in reward.buffers()} == {"cpu"}


def test_refuses_models_that_do_not_fit(pendulum):
    identity = TensorDictModule(nn.Identity(), in_keys=["state"], out_keys=["state"])
    with pytest.raises(TypeError, match=r"must read 'state' and 'action' .* has in_keys \['state'\]"):
        ModelEnv(identity)
    unbound = TensorDictModule(lambda s, a: s, in_keys=["state", "action"], out_keys=[("next", "state")])
    with pytest.raises(TypeError, match="no attribute 'scene'"):
        ModelEnv(unbound)


def test_bad_inputs_are_named(model_env):
    start = model_env.rand_action(model_env.reset(TensorDict(batch_size=[2])))
    with pytest.raises(KeyError, match=r"ModelEnv\('pendulum'\) needs an entry 'state'"):
        model_env.step(start.select("action"))
    with pytest.raises(ValueError, match=r"'action' must be \[2, 1\], got \[2, 3\]"):
        model_env.step(start.set("action", torch.zeros(2, 3)))


def test_steps_a_true_environments_tensordict(scene_env, model_env):
    true = scene_env.reset(TensorDict(batch_size=[2]))
    executed = model_env.rollout(3, tensordict=true, auto_reset=False)
    assert executed["next", "reward"].shape == (2, 3, 1)


def test_runs_a_bound_forward_model(swimmer):
    torch.manual_seed(0)
    model = ForwardModel.for_scene(swimmer, **SMALL)
    env = ModelEnv(model.bind(swimmer), seed=0)
    check_env_specs(env)
    true = SceneEnv(swimmer, seed=0).rollout(4, tensordict=TensorDict(batch_size=[3]))
    update_parameter_normalizers(env.world_model)
    update_dynamic_normalizers(env.world_model, true["state"], true["action"], true["next", "state"])
    actions = true["action"].clone().requires_grad_()
    executed = rollout(env, true[:, 0].select("state"), actions)
    executed["next", "state"].square().sum().backward()
    assert executed["next", "state"].isfinite().all()
    assert (actions.grad != 0).any()


def test_samples_of_another_scene_are_refused(pendulum):
    env = ModelEnv(ForwardModel.for_scene(pendulum, **SMALL).bind(pendulum), seed=0)
    start = env.rand_action(env.reset(TensorDict(batch_size=[2])))
    own, heavy = (
        PhysicalParameters.of(scene).tensordict().expand(2)
        for scene in (pendulum, load_scene("pendulum", parameters={"mass": 2.0}))
    )
    expected = env.step(start.clone())["next", "state"]
    assert torch.equal(env.step(start.clone().set("parameters", own))["next", "state"], expected)
    with pytest.raises(ValueError, match="other parameters 'nodes' than scene 'pendulum'"):
        env.step(start.clone().set("parameters", heavy))


@pytest.mark.parametrize("kind", ["parameters", "inferred", "recurrent"])
def test_specs_name_what_else_a_model_reads(swimmer, kind):
    options = {
        "parameters": {},
        "inferred": {"parameters": "inferred", "inferred": (4, 4, 4)},
        "recurrent": {"core": "recurrent", "hidden_state": [4, 4, 4]},
    }
    model = ForwardModel.for_scene(swimmer, **options[kind], **SMALL)
    env = ModelEnv(model.bind(swimmer, parameters_key=None if kind == "recurrent" else "parameters"), seed=0)
    check_env_specs(env)
    assert ("hidden_state" in env.observation_spec.keys()) == (kind == "recurrent")
    assert ("parameters" in env.state_spec.keys()) == (kind != "recurrent")


def test_a_given_start_must_be_given(scene_env, model_env):
    for env, entry in ((scene_env, "physics"), (model_env, "state")):
        with pytest.raises(KeyError, match=f"needs an entry '{entry}'"):
            env.reset(TensorDict(batch_size=[2]), set_state=True)


def test_a_recurrent_model_forgets_where_an_episode_begins(swimmer):
    torch.manual_seed(0)
    model = ForwardModel.for_scene(swimmer, core="recurrent", hidden_state=[4, 4, 4], **SMALL).bind(swimmer)
    ends = TensorDictModule(lambda action: action[..., :1] > 0.5, in_keys=["action"], out_keys=["terminated"])
    env = ModelEnv(model, done=ends, seed=0)
    played = batched(env, 4).rollout(8, break_when_any_done=False)
    ended = played["next", "done"][:, :-1, 0]
    assert ended.any() and not ended.all()
    for before, after in zip(played["next", "hidden_state"].values(), played["hidden_state"].values(), strict=True):
        if after[0].numel():
            assert (after[:, 1:][ended] == 0).all()
            assert torch.equal(after[:, 1:][~ended], before[:, :-1][~ended]) and (before != 0).any()
    last = played[:, -1]["next"].select("state", "hidden_state")
    assert (env.reset(last.clone(), set_state=False)["hidden_state"]["nodes"] == 0).all()
    kept = env.reset(last.clone(), set_state=True)["hidden_state"]["nodes"]
    assert torch.equal(kept, last["hidden_state", "nodes"])
