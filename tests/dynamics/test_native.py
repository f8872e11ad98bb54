"""The native executor: the same bits under any load, and states unlike the data."""

from __future__ import annotations

import gc
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.dynamics.executors.native import executor as executor_module
from torchrl_gn.dynamics.executors.native.operators import load_operators
from torchrl_gn.dynamics.executors.native.preparation import around_preparation, preparation
from torchrl_gn.scenes import load_scene

from .native import equal, run, vjp, with_compiler

pytestmark = with_compiler

FEW = ("swimmer6", "joints")


# Preparation


def test_whoever_budgets_time_hears_of_every_preparation_and_large_scenes_say_it(wide, capsys):
    predictor, heard = wide("pendulum"), []

    @contextmanager
    def hear():
        heard.append("begins")
        yield
        heard.append("ends")

    with around_preparation(hear):
        for _ in range(2):  # the second time it is there
            predictor.prepared_for_training()
            predictor.prepared(size=10_000)
    predictor.model.bind(predictor.scene).prepared_for_training()
    assert heard == ["begins", "ends"] * 2
    with preparation(29):
        pass
    assert capsys.readouterr().err == ""
    with preparation(70):
        pass
    assert "a step of 70 bodies for C++, once in this process: about 3 min" in capsys.readouterr().err


def test_preparation_runs_without_collection():
    with preparation(3):
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with preparation(3):
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


# The same bits


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("name", FEW)
def test_a_sample_is_the_same_in_every_batch(quick, inputs, name, dtype):
    if dtype == torch.bfloat16 and not load_operators().has_bfloat16():
        pytest.skip("the processor multiplies no bfloat16")
    predictor = quick(name, torch.float64 if dtype == torch.float64 else torch.float32, products=dtype)
    for lifted in (slice(0), slice(None, None, 3)):  # samples whose constant channels are not the scene's
        state, actions = inputs(predictor, 61)
        state[lifted, :, 2] += 0.1
        whole = vjp(predictor, state, actions)
        for count in (1, 2, 3, 4, 5, 8, 9, 16, 17, 24, 25, 48, 60):
            for start in (0, 61 - count):
                part = slice(start, start + count)
                assert equal(vjp(predictor, state[part], actions[part]), [each[part] for each in whole]), count
        order = torch.randperm(61, generator=torch.Generator().manual_seed(0))
        assert equal(vjp(predictor, state[order], actions[order]), [each[order] for each in whole])
    assert predictor.reason is None


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("name", FEW)
def test_the_number_of_threads_does_not_matter(quick, inputs, name, dtype):
    if dtype == torch.bfloat16 and not load_operators().has_bfloat16():
        pytest.skip("the processor multiplies no bfloat16")
    predictor = quick(name, products=dtype)
    for count in (1, 2, 7, 50):
        state, actions = inputs(predictor, count)
        expected = vjp(predictor, state, actions)
        for threads in (2, 3, 8):
            torch.set_num_threads(threads)
            assert equal(vjp(predictor, state, actions), expected)
        torch.set_num_threads(1)


@pytest.mark.slow
@pytest.mark.parametrize("many", [False, True])
def test_long_calls_are_made_in_parts_with_the_same_numbers(wide, inputs, calls, many):
    """The batch may have several axes; gradients of actions and states come in parts, too."""
    predictor = specialize(wide("swimmer6"))
    state, actions = inputs(predictor, 30, 3)
    actions, executor = actions if many else actions[..., 0, :], predictor.executor
    call = predictor.rollout if many else predictor.step

    def found() -> list[torch.Tensor]:
        given = [each.clone().requires_grad_() for each in (state, actions)]
        out = call(*given)[0]
        return [out, *torch.autograd.grad((out * out.detach().cos()).sum(), given)]

    expected, parts = found(), calls(executor, "_operator", lambda first, *_: len(first))
    executor.longest = 1
    assert equal(found(), expected) and sum(parts) == 90 and len(parts) == -(-90 // (24 * torch.get_num_threads()))


def test_parts_are_whole_tiles_of_the_library():
    header = Path(executor_module.__file__).with_name("call.h").read_text()
    assert f"constexpr int64_t kTile = {executor_module._TILE};" in header


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_long_rollouts_of_few_samples_are_made_in_parts_with_the_same_numbers(wide, inputs, calls, dtype):
    """States of single precision would be rounded between the parts, so these are made whole."""
    predictor = specialize(wide("swimmer6"))
    state, actions = (each.to(dtype) for each in inputs(predictor, 2, 3, steps=7))
    expected, executor = predictor.rollout(state, actions)[0], predictor.executor
    executor.longest = 48  # two steps of a tile
    executor.numbers = 1  # for which these are many
    parts = calls(executor, "_operator", lambda *given: given[1].shape[1])
    assert torch.equal(predictor.rollout(state, actions)[0], expected)
    assert parts == ([2, 2, 2, 1] if dtype == torch.float64 else [7])


@pytest.mark.slow
def test_ctrl_c_ends_a_long_call_between_its_parts(wide, inputs, calls, ctrl_c):
    predictor = specialize(wide("swimmer6"))
    state, actions = inputs(predictor, 24 * torch.get_num_threads() * 5)
    predictor.executor.longest = 1
    ctrl_c(predictor.executor, "_operator", 2)
    parts = calls(predictor.executor, "_operator")
    with pytest.raises(KeyboardInterrupt):
        predictor.rollout(state, actions)
    assert len(parts) == 2


@pytest.mark.slow
def test_threads_may_change_between_a_prediction_and_its_gradient(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 50)
    expected = vjp(predictor, state, actions)[2]
    leaf = actions.clone().requires_grad_()
    weights = torch.linspace(-1, 1, 4 * state[0].numel(), dtype=torch.float64).view(4, *state.shape[1:])
    for before, after in ((1, 3), (3, 1), (2, 8)):
        torch.set_num_threads(before)
        states = predictor.rollout(state, leaf)[0]
        torch.set_num_threads(after)
        assert torch.equal(torch.autograd.grad((states * weights).sum(), leaf)[0], expected)


def test_steps_are_those_of_a_rollout(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 5, steps=6)
    states = predictor.rollout(state, actions)[0]
    for step in range(6):
        state = predictor.step(state, actions[:, step])[0]
        assert torch.equal(state, states[:, step + 1])


SCRIPT = """
import sys, numpy, torch
from tests import zoo
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors.native import executor as executor_module
from torchrl_gn.dynamics.executors.native.operators import load_operators
from torchrl_gn.dynamics.executors.native.preparation import around_preparation, preparation
torch.set_num_threads(1)
found = []
for name in ("swimmer6", "joints"):
    for activation in ("relu", "silu", "gelu", "tanh"):
        for dtype in (torch.float32, torch.float64):
            scene = zoo.load(name)
            torch.manual_seed(0)
            model = ForwardModel.for_scene(scene, latent=20, hidden=(36,), activation=activation).to(dtype)
            for normalizer in model.modules():
                if hasattr(normalizer, "m2"):
                    ones = {key: torch.ones_like(value) for key, value in normalizer.state_dict().items()}
                    normalizer.load_state_dict(ones)
            predictor = specialize(model.requires_grad_(False).bind(scene))
            generator = torch.Generator().manual_seed(1)
            state = torch.zeros(9, scene.num_nodes, 13, dtype=torch.float64)
            state[..., 3] = 1
            state[..., 7:] = torch.randn(9, scene.num_nodes, 6, dtype=torch.float64, generator=generator)
            state[..., 7:] *= torch.as_tensor(scene.movable[:, 6:])
            actions = torch.randn(9, 4, scene.num_actions, dtype=torch.float64, generator=generator)
            state.requires_grad_(), actions.requires_grad_()
            states = predictor.rollout(state, actions)[0]
            assert predictor.reason is None, predictor.reason
            gradients = torch.autograd.grad(states[:, 1:].square().sum(), (state, actions))
            found += [each.detach().flatten() for each in (states, *gradients)]
numpy.save(sys.argv[1], torch.cat(found).numpy())
load_operators()
print(next(line.split()[-1] for line in open("/proc/self/maps") if "/operators-" in line))
"""


@pytest.mark.slow
@pytest.mark.skipif(torch.backends.cpu.get_cpu_capability() != "AVX512", reason="the processor has no AVX-512")
def test_with_and_without_avx512_all_bits_are_the_same(tmp_path):
    names = [
        run(SCRIPT, tmp_path / f"{each}.npy", ATEN_CPU_CAPABILITY=each).stdout.split()[-1]
        for each in ("avx512", "avx2")
    ]
    assert names[0] != names[1]
    found = [np.load(tmp_path / f"{each}.npy") for each in ("avx512", "avx2")]
    assert np.isfinite(found[0]).all() and np.ptp(found[0]) > 0
    np.testing.assert_array_equal(*found)


# States that are not finite, or not where the scene's are


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("what", ["state", "constant", "all", "action"])
def test_a_sample_that_is_not_finite_harms_no_other(quick, inputs, what, value):
    predictor = quick()
    state, actions = inputs(predictor, 27)
    fine = vjp(predictor, state, actions)
    bad_state, bad_actions = state.clone(), actions.clone()
    channel = {"state": (3, 0), "constant": (3, 2), "all": (...,), "action": ()}[what]
    (bad_state[11][channel] if channel else bad_actions[11])[...] = value
    found = vjp(predictor, bad_state, bad_actions)
    others = torch.arange(27) != 11
    assert equal([each[others] for each in found], [each[others] for each in fine])
    assert not found[0][11, -1].isfinite().all()
    alone = predictor.rollout(bad_state[11:12], bad_actions[11:12])[0]
    assert torch.equal(alone.nan_to_num(7.0), found[0][11:12].nan_to_num(7.0))
    assert predictor.reason is None


def test_all_samples_not_finite(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    assert not predictor.rollout(state * float("nan"), actions)[0].isfinite().any()


ODD = {
    "zeros": lambda s: torch.zeros_like(s),
    "ones": lambda s: torch.ones_like(s),
    "noise": lambda s: torch.randn(s.shape, generator=torch.Generator().manual_seed(0), dtype=s.dtype),
    "1000 km away": lambda s: s + 1e6 * torch.eye(13, dtype=s.dtype)[0],
    "fast": lambda s: s + 1e3 * torch.eye(13, dtype=s.dtype)[8],
    "no orientation": lambda s: torch.cat((s[..., :3], 1e-20 * s[..., 3:7], s[..., 7:]), -1),
    "long quaternions": lambda s: torch.cat((s[..., :3], 1e20 * s[..., 3:7], s[..., 7:]), -1),
    "turned": lambda s: torch.cat((s[..., :3], -s[..., 3:7], s[..., 7:]), -1),
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_states_are_predicted_as_by_torch(quick, inputs, kind):
    native, eager = (quick(dtype=torch.float64, executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(native, 4)
    plain = native.rollout(state, actions)[0]
    odd = torch.cat((ODD[kind](state[:1]), state[1:]))
    found, wanted = (each.rollout(odd, actions)[0] for each in (native, eager))
    assert torch.equal(found[1:], plain[1:])
    assert torch.equal(found.isfinite(), wanted.isfinite())
    sizes = wanted[:1].abs().nan_to_num(0.0, 0.0, 0.0).amax(-1, keepdim=True)
    assert ((found - wanted)[:1].abs().nan_to_num(0.0, 0.0, 0.0) <= 1e-8 * (1 + sizes)).all()
    assert native.reason is None


def test_states_elsewhere_are_predicted_too(quick, inputs):
    predictor, eager = (quick(dtype=torch.float64, executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(predictor, 5)
    lifted, tilted = state.clone(), state.clone()
    lifted[:, 1:, 2] += 0.1
    tilted[:, 1:, 3:7] = torch.nn.functional.normalize(state[:, 1:, 3:7] + torch.tensor([0, 0.1, 0.2, 0]), dim=-1)
    tilted[:, 1:, 10:12] = 0.3
    mixed = torch.stack((state, lifted, tilted), dim=1).flatten(0, 1)
    for each in (lifted, tilted, mixed, state + 0.01):
        found, wanted = (vjp(one, each, actions.repeat_interleave(len(each) // 5, 0)) for one in (predictor, eager))
        for a, b in zip(found, wanted, strict=True):
            if a.shape == each.shape:  # gradients in constant channels are those of copying
                varies = torch.as_tensor(predictor.scene.movable[:, [0, 1, 2, 3, 4, 5, 6, 6, 7, 8, 9, 10, 11]])
                varies[:, 3:7] = False
                a, b = a * varies, b * varies
            assert (a - b).norm() <= 1e-10 * b.norm()
    assert predictor.reason is None


def test_the_order_of_states_does_not_matter(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 4)
    lifted = state + torch.eye(13, dtype=torch.float64)[2]
    apart = [vjp(predictor, lifted, actions), vjp(predictor, state, actions)]
    together = [torch.cat(each) for each in zip(*apart, strict=True)]
    mixed, both = torch.cat((lifted, state)), torch.cat((actions, actions))
    for order in (torch.arange(8), torch.arange(8).flip(0), torch.tensor([0, 4, 1, 5, 2, 6, 3, 7])):
        assert equal(vjp(predictor, mixed[order], both[order]), [each[order] for each in together])


@pytest.mark.parametrize("name", FEW)
def test_at_rest_gradients_are_finite(quick, name):
    """Square roots and angles at zero, as in a scene's first state."""
    predictor, eager = (quick(name, torch.float64, executor=executor) for executor in ("native", "eager"))
    state = torch.zeros(2, predictor.scene.num_nodes, 13, dtype=torch.float64)
    state[..., 3] = 1
    actions = torch.zeros(2, 2, predictor.scene.num_actions, dtype=torch.float64)
    found, expected = (vjp(each, state, actions) for each in (predictor, eager))
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(found[2], expected[2], rtol=1e-9, atol=1e-12)
    assert found[1].isfinite().all()
    assert predictor.reason is None


@pytest.mark.filterwarnings("ignore::torchrl_gn.dynamics.UnseenParameterWarning")
def test_gradients_of_a_network_without_outputs_hold_nothing_of_earlier_calls():
    """States never changed in the data of the second network, so it has no outputs."""
    scene = load_scene(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .5" gravcomp="1"><freejoint/>
        <geom type="box" size=".1 .2 .1"/></body></worldbody></mujoco>"""
    )
    states = torch.from_numpy(scene.reference_state).repeat(4, 1, 1)
    states[:, 1, 2] += torch.arange(4) / 8
    actions, still = torch.zeros(4, 3, 0, dtype=torch.float64), torch.zeros_like(states)
    moving = still.clone()
    moving[:, 1, :3] = torch.arange(12).view(4, 3) / 16

    def predictors(change):
        torch.manual_seed(0)
        model = ForwardModel.for_scene(scene, hidden=32).double()
        update_parameter_normalizers(bound := model.bind(scene))
        update_dynamic_normalizers(bound, states, actions[:, 0], states + change)
        network = model.requires_grad_(False).bind(scene)
        return [specialize(network, executor=executor) for executor in ("native", "eager")]

    def gradient(predictor):
        start = states.clone().requires_grad_()
        return torch.autograd.grad(predictor.rollout(start, actions)[0].square().sum(), start)[0][:, 1]

    other, (native, torchs) = predictors(moving)[0], predictors(still)
    gradient(other)  # leaves its numbers in memory that the next call uses
    torch.testing.assert_close(gradient(native), gradient(torchs))
    assert native.reason is None
