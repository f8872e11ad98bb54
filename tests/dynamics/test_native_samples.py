"""The native executor with physical parameters of each sample: traces, and numbers that samples share."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.dynamics import BodyState, BoundPredictor, Controls, ForwardModel, JointAxes, specialize
from torchrl_gn.dynamics.bound import update_parameter_normalizers
from torchrl_gn.dynamics.executors.native import executor
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs, batch_of
from torchrl_gn.dynamics.features import Feature
from torchrl_gn.networks.packed_layers import PackedLayers
from torchrl_gn.scenes import sample_variants
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

from ..sizes import SMALL
from .native import equal, vjp, with_compiler

pytestmark = with_compiler


class OfVariants:
    """A bound predictor of its samples' parameters and the specialised one, with states and actions of variants."""

    def __init__(self, bound: BoundPredictor, state, actions, parameters: TensorDict, predictor=None) -> None:
        self.bound, self.inputs, self.parameters = bound, (state, actions), parameters
        self.predictor = specialize(bound) if predictor is None else predictor

    @property
    def core(self) -> PackedLayers:
        """Packed layers of all samples, which run natively."""
        prepared = self.predictor.prepared(self.parameters)
        assert prepared.executor.reason is None and isinstance(prepared.program.core, PackedLayers)
        return prepared.program.core

    def vjp(self, at=slice(None), parameters=None, predictor=None):
        """States of samples' rollout, and gradients of a function of them."""
        parameters = self.parameters[at] if parameters is None else parameters
        return vjp(predictor or self.predictor, *(each[at] for each in self.inputs), parameters)


def same(found, expected) -> None:
    """Equal but for rounding of the tables, which torch makes for all samples at once."""
    for got, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(got, wanted, rtol=0, atol=1e-12)


@pytest.fixture
def of_variants(scenes, fit, moved, random_actions):
    def make(name="swimmer6", count=30, dtype=torch.float64, **options) -> OfVariants:
        sizes = {} if "core" in options else {"latent": 20, "edge_hidden": (36,), "node_hidden": (36,)}
        scene = scenes[name]
        torch.manual_seed(0)
        model = ForwardModel.for_scene(scene, activation="silu", **sizes, **options)
        model = fit(model, scene).to(dtype).requires_grad_(False)
        bound = model.bind(scene, parameters_key="parameters")
        varied = torch.stack([PhysicalParameters.of(each).tensordict() for each in sample_variants(name, count, rng=0)])
        update_parameter_normalizers(bound, varied)
        parameters = torch.stack([bound.parameters_of(each) for each in sample_variants(name, count, rng=0)])
        return OfVariants(bound, moved(bound, count), random_actions(scene, count, 3, seed=3), parameters)

    return make


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
@pytest.mark.parametrize("core", ["gn", "mlp"])
def test_batches_and_threads(of_variants, core, dtype, bound):
    options = {"core": "mlp", "hidden": (36, 20)} if core == "mlp" else {}
    variants = of_variants(count=61, dtype=dtype, **options)
    whole = variants.vjp()
    tables = [each for each in variants.core._plain_tables() if each is not None and each.shape[1] == 61]
    assert any(((table[:, 0] - table[:, 1]).abs() > 1e-2).any() for table in tables)
    eager = specialize(variants.bound, executor="eager")
    for at in (slice(0, 2), slice(1, 4), slice(30, 54), slice(7, 32), slice(1, 61)):
        wanted = variants.vjp(at, predictor=eager)
        for got in (variants.vjp(at), [each[at] for each in whole]):
            # A specialised model takes channels that cannot move for constants: of the gradients, that in actions.
            assert (got[0] - wanted[0]).norm() <= bound * (wanted[0] - wanted[0][:, :1]).norm()
            assert (got[2] - wanted[2]).norm() <= bound * wanted[2].norm()
    prepared = variants.predictor.prepared(variants.parameters)  # torch's own sums may depend on threads
    whole = vjp(prepared, *variants.inputs)
    for threads in (2, 3, 8):
        torch.set_num_threads(threads)
        assert equal(vjp(prepared, *variants.inputs), whole)


@pytest.mark.slow
def test_one_sample_and_parameters_without_batch(of_variants):
    variants = of_variants(count=4)
    whole = variants.vjp()
    for parameters in (variants.parameters[2:3], variants.parameters[2]):
        one = variants.vjp(slice(2, 3), parameters)
        same(one, [each[2:3] for each in whole])
    shared = variants.vjp(slice(None), variants.parameters[2])
    torch.testing.assert_close(shared[0][2], whole[0][2], rtol=0, atol=1e-12)
    core = variants.predictor.prepared(variants.parameters[2]).program.core
    assert core.sample_tables is None and variants.core.sample_tables is not None


def test_inputs_are_what_samples_have_of_their_own(of_variants):
    bound = of_variants(count=2).bound
    program, parameters = bound.program(), bound.scene_parameters
    assert batch_of(parameters) == ()
    inputs = ParameterInputs.of(program)
    assert len(inputs) == 0 and inputs.read(parameters).shape == (1, 0)
    anchors = parameters.child_anchor.expand(2, 3, -1, -1).clone()
    usual = (anchors[0, 0] != 0) & (anchors[0, 0].abs() != 1)  # all but the numbers that make short state maths
    varied = parameters._replace(child_anchor=anchors)
    assert batch_of(varied) == (2, 3)
    more = ParameterInputs.of(replace(program, parameters=varied))
    assert len(more) == usual.sum() and torch.equal(more.read(varied)[0], anchors[0, 0][usual])
    assert anchors[0, 0, 1, 2] == 0
    anchors[1, 2, 1, 2] += 0.1
    most = ParameterInputs.of(replace(program, parameters=varied))
    assert len(most) == len(more) + 1 and most.read(varied).shape == (6, len(most))
    names = [f"input {index}" for index in range(len(most))]
    (array,) = most.arrays(names)
    assert set(array.ravel()) == {*names, *anchors[0, 0][~usual].tolist()} and array[1, 2] in names


@pytest.mark.slow
def test_state_maths_are_traced_once_for_all_values(of_variants, calls):
    variants = of_variants(count=6)
    whole = variants.vjp()
    one = variants.vjp(slice(1, 2))
    traced = calls(executor, "StateMaths")
    order = [5, 0, 3, 1, 4, 2]
    same(variants.vjp(order), [each[order] for each in whole])
    same(variants.vjp(slice(2, 3)), [each[2:3] for each in whole])
    same(one, [each[1:2] for each in whole])
    assert not traced


@pytest.mark.slow
def test_samples_that_need_other_state_maths(of_variants):
    variants = of_variants(count=6)
    state, actions = variants.inputs
    lifted = state.clone()
    lifted[::2, :, 2] += 1.0  # a height that cannot change
    mixed = OfVariants(variants.bound, lifted, actions, variants.parameters, variants.predictor)
    found = mixed.vjp()
    eager = mixed.vjp(predictor=specialize(variants.bound, executor="eager"))
    torch.testing.assert_close(found[0], eager[0], rtol=0, atol=1e-10)
    torch.testing.assert_close(found[2], eager[2], rtol=1e-8, atol=1e-10)
    for index in range(6):
        same([each[index : index + 1] for each in found], mixed.vjp(slice(index, index + 1)))
    # Of samples whose state maths differ, step and gradient as of those whose do not.
    same([each[::2] for each in found], mixed.vjp(slice(None, None, 2)))
    same([each[1::2] for each in found], mixed.vjp(slice(1, None, 2)))


@pytest.mark.slow
def test_gradients_after_other_parameters(of_variants):
    variants = of_variants(count=4)
    halves = [slice(0, 2), slice(2, 4)]
    expected = [variants.vjp(at) for at in halves]
    (state, actions), predictor = variants.inputs, variants.predictor
    leaf = actions.clone().requires_grad_()
    states = [predictor.rollout(state[at], leaf[at], variants.parameters[at])[0] for at in halves]
    predictor.rollout(state[:0], leaf[:0], variants.parameters[:0])
    weights = torch.linspace(-1, 1, states[0][0].numel(), dtype=torch.float64).view(states[0].shape[1:])
    sum((each * weights).sum() for each in states).backward()
    assert leaf.grad is not None and torch.equal(leaf.grad, torch.cat([each[2] for each in expected]))


@pytest.mark.slow
def test_no_samples(of_variants):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    assert variants.predictor.rollout(state[:0], actions[:0], variants.parameters[:0])[0].shape[0] == 0
    assert variants.core


@pytest.mark.slow
def test_the_scenes_own_parameters(of_variants):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    predictor, eager = variants.predictor, specialize(variants.bound, executor="eager")
    expected = eager.step(state, actions[:, 0])[0]
    for _ in range(2):  # before and after those of samples
        for parameters in (None, predictor.own_parameters(), predictor.own_parameters().expand(4)):
            torch.testing.assert_close(
                predictor.step(state, actions[:, 0], parameters)[0], expected, rtol=0, atol=1e-10
            )
        predictor.step(state, actions[:, 0], variants.parameters)


@pytest.mark.slow
def test_parameters_that_change_in_place(of_variants):
    variants = of_variants(count=1)
    (state, actions), predictor = variants.inputs, variants.predictor
    own = variants.parameters[0].clone()
    predictor.rollout(state, actions, own)
    own["child_anchor"].mul_(1.1)
    expected = specialize(variants.bound, executor="eager").rollout(state, actions, own)[0]
    torch.testing.assert_close(predictor.rollout(state, actions, own)[0], expected, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_refresh_takes_new_weights(of_variants):
    variants = of_variants(count=4)
    before = variants.vjp()
    with torch.no_grad():
        for weight in variants.bound.model.parameters():
            weight.mul_(1.1)
    assert equal(variants.vjp(), before)
    variants.predictor.refresh(variants.bound)
    after = variants.vjp()
    assert not torch.equal(after[0], before[0])
    same(after, variants.vjp(predictor=specialize(variants.bound)))


@pytest.mark.slow
def test_prepared_parameters_are_folded_once(of_variants, folds):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    expected = variants.vjp()[0]
    prepared = variants.predictor.prepared(variants.parameters)
    folds.clear()
    for step in range(3):
        state = prepared.step(state, actions[:, step])[0]
        torch.testing.assert_close(state, expected[:, step + 1], rtol=0, atol=1e-12)
    assert not folds


@pytest.mark.slow
def test_samples_may_bring_some_parameters(of_variants):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    some = variants.parameters.select("child_anchor")
    expected = specialize(variants.bound, executor="eager").rollout(state, actions, some)[0]
    found = variants.predictor.rollout(state, actions, some)[0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_threads_with_parameters_of_their_own(of_variants):
    variants = of_variants(count=8)
    (state, actions), predictor = variants.inputs, variants.predictor
    halves = [slice(0, 4), slice(4, 8)]
    expected = [predictor.rollout(state[at], actions[at], variants.parameters[at])[0] for at in halves]
    wrong = []

    def work(index: int) -> None:
        at, parameters = halves[index], variants.parameters[halves[index]]
        for _ in range(20):
            states = predictor.rollout(state[at], actions[at], parameters)[0]
            if not torch.equal(states, expected[index]):
                wrong.append(index)

    threads = [threading.Thread(target=work, args=(index,)) for index in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@dataclass(frozen=True)
class LogOfAnchors(Feature):
    """Reads a parameter by an operation that has no scalar form."""

    part: ClassVar[Literal["nodes", "edges"]] = "nodes"

    def size(self, layout) -> int:
        return 1

    def bind(self, scene, layout, canonicalizer):
        return LogOfAnchor()


class LogOfAnchor(torch.nn.Module):
    def forward(self, inputs):
        logs = inputs.parameters.child_anchor.abs().sum(-1, keepdim=True).add(1e-3).log()
        return logs.expand(*inputs.canonical.state.shape[:-1], 1)


@pytest.mark.slow
def test_constants_may_be_read_by_any_operation(fit, scenes, random_states, random_actions):
    scene = scenes["swimmer6"]
    features = (BodyState(), Controls(), JointAxes(), LogOfAnchors())
    model = fit(ForwardModel.for_scene(scene, features=features, **SMALL), scene).requires_grad_(False)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    fast, eager = (specialize(model.bind(scene), executor=name) for name in ("native", "eager"))
    torch.testing.assert_close(fast.step(state, action)[0], eager.step(state, action)[0], rtol=1e-5, atol=1e-6)
    assert fast.reason is None
    varied = specialize(model.bind(scene, parameters_key="parameters"))
    parameters = varied.own_parameters().expand(3).clone()
    parameters["child_anchor"][1] *= 1.1
    expected = specialize(model.bind(scene, parameters_key="parameters"), executor="eager")
    wanted = expected.step(state, action, parameters)[0]
    torch.testing.assert_close(varied.step(state, action, parameters)[0], wanted)
    assert "no scalar form" in varied.prepared(parameters).executor.reason


@pytest.mark.slow
def test_another_number_of_samples_is_refused(of_variants):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    with pytest.raises(ValueError, match="parameters"):
        variants.predictor.rollout(state[:3], actions[:3], variants.parameters)
    prepared = variants.predictor.prepared(variants.parameters)
    with pytest.raises(ValueError, match="tables of each sample"):
        prepared.rollout(state[:3], actions[:3])
