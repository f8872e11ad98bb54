"""The native executor with physical parameters of each sample: what it traces, and what samples share."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import ClassVar, Literal

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.dynamics import BodyState, Controls, ForwardModel, JointAxes, SpecializedPredictor, specialize
from torchrl_gn.dynamics.bound import update_parameter_normalizers
from torchrl_gn.dynamics.executors import NativeExecutor
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs, batch_of
from torchrl_gn.dynamics.features import Feature
from torchrl_gn.scenes import sample_variants
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

from ..sizes import SMALL
from .test_native import equal, pytestmark  # noqa: F401  which skips without a compiler


class OfVariants:
    """A predictor bound to the parameters of its samples, with states, actions and parameters of variants."""

    def __init__(self, predictor: SpecializedPredictor, state, actions, parameters: TensorDict) -> None:
        self.predictor, self.inputs, self.parameters = predictor, (state, actions), parameters

    @property
    def native(self):
        executor = self.predictor.executor(self.parameters)
        assert isinstance(executor, NativeExecutor) and executor.reason is None and executor.native is not None
        return executor.native

    def pull(self, at=slice(None), parameters=None, predictor=None):
        """States of samples' rollout, and gradients of a function of them."""
        leaves = [each[at].clone().requires_grad_() for each in self.inputs]
        parameters = self.parameters[at] if parameters is None else parameters
        states = (predictor or self.predictor).rollout(*leaves, parameters)[0]
        weights = torch.linspace(-1, 1, states[0].numel(), dtype=states.dtype).view(states.shape[1:])
        return [states.detach(), *torch.autograd.grad((states * weights).sum(), leaves)]


def same(found, expected) -> None:
    """Equal but for rounding of the tables, which torch makes for all samples at once."""
    for got, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(got, wanted, rtol=0, atol=1e-12)


@pytest.fixture
def of_variants(scenes, fit, random_states, random_actions):
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
        state = random_states(scene, count, seed=3, scale=0.3)
        return OfVariants(specialize(bound), state, random_actions(scene, count, 3, seed=3), parameters)

    return make


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
@pytest.mark.parametrize("core", ["gn", "mlp"])
def test_batches_and_threads(of_variants, core, dtype, bound):
    options = {"core": "mlp", "hidden": (36, 20)} if core == "mlp" else {}
    variants = of_variants(count=61, dtype=dtype, **options)
    whole = variants.pull()
    samples = variants.native.samples
    assert samples.count == 61
    own = [table for table in samples.tables if table is not None]
    assert any(((table[:, 0] - table[:, 1]).abs() > 1e-2).any() for table in own)
    eager = specialize(variants.predictor, executor="eager")
    for at in (slice(0, 2), slice(1, 4), slice(30, 54), slice(7, 32), slice(1, 61)):
        wanted = variants.pull(at, predictor=eager)
        for got in (variants.pull(at), [each[at] for each in whole]):
            # A specialised model takes channels that cannot move for constants: of the gradients, that in actions.
            assert (got[0] - wanted[0]).norm() <= bound * (wanted[0] - wanted[0][:, :1]).norm()
            assert (got[2] - wanted[2]).norm() <= bound * wanted[2].norm()
    variants.pull()
    for threads in (2, 3, 8):
        torch.set_num_threads(threads)
        assert equal(variants.pull(), whole)


def test_one_sample_and_parameters_without_batch(of_variants):
    variants = of_variants(count=4)
    whole = variants.pull()
    for parameters in (variants.parameters[2:3], variants.parameters[2]):
        one = variants.pull(slice(2, 3), parameters)
        same(one, [each[2:3] for each in whole])
    shared = variants.pull(slice(None), variants.parameters[2])
    torch.testing.assert_close(shared[0][2], whole[0][2], rtol=0, atol=1e-12)
    assert variants.predictor.executor(variants.parameters[2]).native.samples.count is None


def test_only_what_differs_is_an_input(of_variants):
    parameters = of_variants().predictor.parameter_reader.own
    assert batch_of(parameters) == ()
    inputs = ParameterInputs.of(parameters, None)
    assert len(inputs) == 0 and inputs.read(parameters).shape == (1, 0)
    anchors = parameters.child_anchor.expand(2, 3, -1, -1).clone()
    anchors[1, 2, 4, 0] += 0.1
    varied = parameters._replace(child_anchor=anchors)
    assert batch_of(varied) == (2, 3)
    more = ParameterInputs.of(varied, inputs)
    assert len(more) == 1 and more.read(varied).flatten().tolist() == anchors[..., 4, 0].flatten().tolist()
    assert ParameterInputs.of(varied, more) is more and ParameterInputs.of(parameters, more) is more
    anchors[0, 0, 1, 2] += 0.1
    most = ParameterInputs.of(varied, more)
    assert len(most) == 2 and most.read(varied).shape == (6, 2)


def test_state_maths_are_traced_once_for_all_values(of_variants, monkeypatch):
    variants = of_variants(count=6)
    whole = variants.pull()
    monkeypatch.setattr(
        "torchrl_gn.dynamics.executors.native.traced_program.StateMaths", lambda *_: pytest.fail("traced")
    )
    order = [5, 0, 3, 1, 4, 2]
    same(variants.pull(order), [each[order] for each in whole])
    same(variants.pull(slice(1, 2)), [each[1:2] for each in whole])


def test_samples_that_need_other_state_maths(of_variants):
    variants = of_variants(count=6)
    state, actions = variants.inputs
    lifted = state.clone()
    lifted[::2, :, 2] += 1.0  # a height that cannot change
    found = OfVariants(variants.predictor, lifted, actions, variants.parameters).pull()
    for index in range(6):
        alone = OfVariants(specialize(variants.predictor), lifted, actions, variants.parameters)
        same([each[index : index + 1] for each in found], alone.pull(slice(index, index + 1)))
    assert variants.native.traced.reason is None


def test_gradients_after_other_parameters(of_variants):
    variants = of_variants(count=4)
    expected = [variants.pull(slice(0, 2)), variants.pull(slice(2, 4))]
    (state, actions), predictor = variants.inputs, variants.predictor
    leaf = actions.clone().requires_grad_()
    halves = [slice(0, 2), slice(2, 4)]
    states = [predictor.rollout(state[at], leaf[at], variants.parameters[at])[0] for at in halves]
    weights = torch.linspace(-1, 1, states[0][0].numel(), dtype=torch.float64).view(states[0].shape[1:])
    sum((each * weights).sum() for each in states).backward()
    assert leaf.grad is not None and torch.equal(leaf.grad, torch.cat([each[2] for each in expected]))


def test_no_samples(of_variants):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    assert variants.predictor.rollout(state[:0], actions[:0], variants.parameters[:0])[0].shape[0] == 0
    assert variants.native.traced.reason is None


def test_an_empty_batch_between_changes_no_weights(of_variants):
    variants = of_variants(count=4)
    (state, actions), predictor = variants.inputs, variants.predictor
    leaf, traced = actions.clone().requires_grad_(), variants.native.traced
    first = predictor.rollout(state[:2], leaf[:2], variants.parameters[:2])[0]
    predictor.rollout(state[:0], leaf[:0], variants.parameters[:0])
    second = predictor.rollout(state[2:], leaf[2:], variants.parameters[2:])[0]
    (first.sum() + second.sum()).backward()
    assert variants.native.traced is traced


def test_the_scenes_own_parameters_after_those_of_samples(of_variants):
    variants = of_variants(count=4)
    (state, actions), predictor = variants.inputs, variants.predictor
    expected = specialize(predictor, executor="eager").step(state, actions[:, 0])[0]
    predictor.step(state, actions[:, 0], variants.parameters)
    for _ in range(4):  # single steps are called without ctypes once they can be
        torch.testing.assert_close(predictor.step(state, actions[:, 0])[0], expected, rtol=0, atol=1e-10)
    fresh = specialize(predictor)
    for _ in range(3):
        torch.testing.assert_close(fresh.step(state, actions[:, 0])[0], expected, rtol=0, atol=1e-10)
    variants.native  # noqa: B018  runs natively


def test_parameters_that_change_in_place(of_variants):
    variants = of_variants(count=1)
    (state, actions), predictor = variants.inputs, variants.predictor
    own = variants.parameters[0].clone()
    predictor.rollout(state, actions, own)
    own["child_anchor"].mul_(1.1)
    expected = specialize(predictor, executor="eager").rollout(state, actions, own)[0]
    torch.testing.assert_close(predictor.rollout(state, actions, own)[0], expected, rtol=0, atol=1e-10)


def test_samples_may_bring_some_parameters(of_variants):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    some = variants.parameters.select("child_anchor")
    expected = specialize(variants.predictor, executor="eager").rollout(state, actions, some)[0]
    found = specialize(variants.predictor).rollout(state, actions, some)[0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)


def test_threads_with_parameters_of_their_own(of_variants):
    variants = of_variants(count=8)
    (state, actions), predictor = variants.inputs, variants.predictor
    variants.pull()  # so that all that differs is an input
    halves = [slice(0, 4), slice(4, 8)]
    expected = [predictor.rollout(state[at], actions[at], variants.parameters[at])[0] for at in halves]
    wrong = []

    def work(index: int) -> None:
        at, parameters = halves[index], variants.parameters[halves[index]]
        for _ in range(150):
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


def test_constants_may_be_read_by_any_operation(fit, scenes, random_states, random_actions):
    scene = scenes["swimmer6"]
    features = (BodyState(), Controls(), JointAxes(), LogOfAnchors())
    model = fit(ForwardModel.for_scene(scene, features=features, **SMALL), scene).requires_grad_(False)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    fast, eager = (specialize(model.bind(scene), executor=name) for name in ("native", "eager"))
    torch.testing.assert_close(fast.step(state, action)[0], eager.step(state, action)[0], rtol=1e-5, atol=1e-6)
    assert fast.executor().reason is None
    varied = specialize(model.bind(scene, parameters_key="parameters"))
    parameters = varied.own_parameters().expand(3).clone()
    parameters["child_anchor"][1] *= 1.1
    varied.step(state, action, parameters)
    assert "no scalar form" in varied.executor(parameters).reason


def test_another_number_of_samples_is_refused(of_variants):
    variants = of_variants(count=4)
    state, actions = variants.inputs
    with pytest.raises(ValueError, match="parameters"):
        variants.predictor.rollout(state[:3], actions[:3], variants.parameters)
    executor = variants.predictor.executor(variants.parameters)
    assert executor.running(state, actions) is not None and executor.running(state[:3], actions[:3]) is None
