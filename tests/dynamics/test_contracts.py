"""Contracts under all of PyTorch's operations: a bound model has its current weights, a specialised one is a value.

Right is the reference, by message passing: of the present weights for a bound model, of those that a specialised one
was made or last refreshed with.
"""

from __future__ import annotations

import copy
import functools
import io
import multiprocessing
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.autograd.functional import hessian, hvp
from torch.func import functional_call, stack_module_state
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.optim.swa_utils import AveragedModel

from torchrl_gn.dynamics import BoundPredictor, ForwardModel, Predictor, specialize
from torchrl_gn.training.muon import Muon

from ..compiling import compiles
from .native import with_compiler

pytestmark = with_compiler

KINDS = ["bound", "native", "eager"]
MANY = 60  # samples of rollouts of 10 steps: as many as bound models run natively


@dataclass
class Case:
    """A model, a predictor of it, and its weights at the start."""

    kind: str
    bound: BoundPredictor
    predictor: Predictor
    state: Tensor
    actions: Tensor

    @property
    def model(self) -> ForwardModel:
        return self.bound.model

    def reference(self, model: ForwardModel | None = None) -> Tensor:
        """Rollout by message passing, with which all other ways are compared."""
        reference = (self.model if model is None else model).bind(self.bound.scene, reference=True)
        with torch.no_grad():
            return reference.rollout(self.state, self.actions)[0]

    def is_of(self, expected: Tensor, predictor: Predictor | None = None) -> bool:
        """Whether all ways of predicting give these states."""
        predictor = self.predictor if predictor is None else predictor
        with torch.no_grad():
            given = TensorDict({"state": self.state[:3], "action": self.actions[:3, 0]}, [3])
            found = {
                "many": (predictor.rollout(self.state, self.actions)[0], expected),
                "few": (predictor.rollout(self.state[:3], self.actions[:3])[0], expected[:3]),
                "step": (predictor.step(self.state[:3], self.actions[:3, 0])[0], expected[:3, 1]),
                "steps": (predictor.step(self.state, self.actions[:, 0])[0], expected[:, 1]),
                "forward": (predictor(given)["next", "state"], expected[:3, 1]),
                "change": (predictor.delta(self.state, self.actions[:, 0]), self._change(expected)),
                "prepared": (predictor.prepared(size=600).rollout(self.state, self.actions)[0], expected),
                "forced": (
                    predictor.teacher_forced(expected[:, :-1], self.actions)[0],
                    expected[:, 1:],
                ),
            }
        close = {name: torch.allclose(*each, rtol=0, atol=1e-9) for name, each in found.items()}
        assert len(set(close.values())) == 1, close  # all of one model
        return all(close.values())

    def _change(self, states: Tensor) -> Tensor:
        return self.bound.layout.delta(states[:, 0], states[:, 1])

    def check_changed(self, before: Tensor) -> None:
        """Check that a bound model uses changed weights, and a specialised one only after a refresh."""
        now = self.reference()
        assert (now - before).abs().max() > 1e-5
        assert self.is_of(now if self.kind == "bound" else before)
        if self.kind != "bound":
            self.predictor.refresh(self.bound)  # pyright: ignore[reportAttributeAccessIssue]
            assert self.is_of(now)


@pytest.fixture(scope="module")
def fitted(fit, scenes) -> Callable[..., ForwardModel]:
    """A model in float64 with random weights."""

    @functools.cache
    def made(seed: int) -> ForwardModel:
        torch.manual_seed(seed)
        scene = scenes["pendulum"]
        return fit(ForwardModel.for_scene(scene, latent=16, hidden=(16,)).double(), scene)

    return lambda seed=0: copy.deepcopy(made(seed))


@pytest.fixture(scope="module")
def specialised(scenes, fitted) -> Callable[..., Predictor]:
    """A copy of a specialised predictor of that model."""

    @functools.cache
    def made(kind: str, seed: int) -> Predictor:
        return specialize(fitted(seed).bind(scenes["pendulum"]), executor=kind)

    return lambda kind, seed=0: copy.deepcopy(made(kind, seed))


@pytest.fixture
def case(fitted, specialised, scenes, moved, random_actions) -> Callable[[str], Case]:
    def make(kind: str) -> Case:
        bound = fitted().bind(scenes["pendulum"])
        predictor = bound if kind == "bound" else specialised(kind)
        return Case(kind, bound, predictor, moved(bound, MANY), random_actions(bound.scene, MANY, 10))

    return make


# Whatever changes weights


def loss_of(model: ForwardModel) -> Tensor:
    return sum((weight.sin().sum() for weight in model.parameters()), torch.zeros(()))


def steps_of(make: Callable[[list[nn.Parameter]], torch.optim.Optimizer]) -> Callable[[ForwardModel], None]:
    def change(model: ForwardModel) -> None:
        optimizer = make([weight for weight in model.parameters() if weight.ndim == 2])
        for _ in range(2):
            optimizer.zero_grad()
            loss_of(model).backward()
            optimizer.step()

    return change


def other(model: ForwardModel) -> ForwardModel:
    """Copy of a model with other weights."""
    copied = copy.deepcopy(model)
    with torch.no_grad():
        for weight in copied.parameters():
            weight.mul_(1.1)
    return copied


def assign_data(model: ForwardModel) -> None:
    for weight in model.parameters():
        weight.data = 1.1 * weight.data


def write_data(model: ForwardModel) -> None:
    for weight in model.parameters():
        weight.data.mul_(1.1)  # unseen by autograd


def swap_average(model: ForwardModel) -> None:
    average = AveragedModel(model, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.5))
    average.update_parameters(model)
    average.update_parameters(other(model))
    model.load_state_dict(average.module.state_dict())


@torch.no_grad()
def lerp(model: ForwardModel) -> None:
    torch._foreach_lerp_(list(model.parameters()), list(other(model).parameters()), 0.5)


def replace_parameters(model: ForwardModel) -> None:
    for layer in model.modules():
        for name, weight in list(layer.named_parameters(recurse=False)):
            setattr(layer, name, nn.Parameter(1.1 * weight.detach()))


def write_memory(model: ForwardModel) -> None:
    for weight in model.parameters():
        weight.detach().numpy()[...] *= 1.1


@torch.no_grad()
def from_vector(model: ForwardModel) -> None:
    vector_to_parameters(1.1 * parameters_to_vector(model.parameters()), model.parameters())


def other_statistics(model: ForwardModel) -> None:
    normalizer = model.residual_normalizer
    normalizer.load_state_dict({**normalizer.state_dict(), "m2": 1.5 * normalizer.m2})


def to_module(model: ForwardModel) -> None:
    TensorDict.from_module(other(model)).detach().clone().to_module(model)


CHANGES: dict[str, Callable[[ForwardModel], Any]] = {
    "adam, fused": steps_of(lambda weights: torch.optim.Adam(weights, lr=0.01, fused=True)),
    "adam, foreach": steps_of(lambda weights: torch.optim.Adam(weights, lr=0.01, foreach=True)),
    "adam, one by one": steps_of(lambda weights: torch.optim.Adam(weights, lr=0.01, foreach=False)),
    "sgd": steps_of(lambda weights: torch.optim.SGD(weights, lr=0.01)),
    "muon": steps_of(lambda weights: Muon(weights, lr=0.1)),
    "load_state_dict": lambda model: model.load_state_dict(other(model).state_dict()),
    "load_state_dict, assign": lambda model: model.load_state_dict(other(model).state_dict(), assign=True),
    "data assigned": assign_data,
    "data written": write_data,
    "memory written": write_memory,
    "vector_to_parameters": from_vector,
    "moving average": swap_average,
    "lerp": lerp,
    "parameters replaced": replace_parameters,
    "statistics": other_statistics,
    "tensordict": to_module,
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", KINDS)
def test_changed_weights(case, kind, change):
    tried = case(kind)
    before = tried.reference()
    assert tried.is_of(before)
    CHANGES[change](tried.model)
    tried.check_changed(before)


@pytest.mark.slow
def test_a_functional_call_has_the_weights_that_it_is_given(case, fitted):
    tried = case("bound")
    others = fitted(1)
    for predictor in (tried.bound, tried.model.bind(tried.bound.scene, reference=True)):
        weights = {f"model.{name}": weight for name, weight in others.named_parameters()}
        weights |= {f"model.{name}": each for name, each in others.named_buffers()}
        found = functional_call(
            Rollout(predictor),
            {f"predictor.{name}": each for name, each in weights.items()},
            (tried.state, tried.actions),
        )
        torch.testing.assert_close(found, tried.reference(others), rtol=0, atol=1e-9)
    assert tried.is_of(tried.reference())


class Rollout(nn.Module):
    """The states of a rollout, as a call."""

    def __init__(self, predictor: Predictor) -> None:
        super().__init__()
        self.predictor = predictor

    def forward(self, state: Tensor, actions: Tensor) -> Tensor:
        return self.predictor.rollout(state, actions)[0]


# What is done to a specialised predictor is done to its weights


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["native", "eager"])
def test_the_buffers_of_another_snapshot(case, specialised, fitted, kind):
    tried, given = case(kind), specialised(kind, 1)
    before, others = tried.reference(), tried.reference(fitted(1))
    buffers = {f"predictor.{name}": buffer for name, buffer in given.named_buffers()}
    found = functional_call(Rollout(tried.predictor), buffers, (tried.state, tried.actions))
    torch.testing.assert_close(found, others, rtol=0, atol=1e-9)
    assert tried.is_of(before)
    with TensorDict.from_module(given).to_module(tried.predictor):
        assert tried.is_of(others)
    assert tried.is_of(before)
    own = dict(tried.predictor.named_buffers())
    with torch.no_grad():
        for name, buffer in given.named_buffers():
            if buffer.is_floating_point():
                own[name].lerp_(buffer, 1.0)
    assert tried.is_of(others)
    tried.predictor.load_state_dict(specialised(kind).state_dict())
    assert tried.is_of(before)
    for name, buffer in given.named_buffers():
        own[name].data = buffer.data
    assert tried.is_of(others)


COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda model: pickle.loads(pickle.dumps(model)),
    "saved": lambda model: torch.load(_saved(model), weights_only=False),
    "cast and back": lambda model: copy.deepcopy(model).double(),
    "shared": lambda model: copy.deepcopy(model).share_memory(),
}


def _saved(model) -> io.BytesIO:
    file = io.BytesIO()
    torch.save(model, file)
    file.seek(0)
    return file


@pytest.mark.slow
@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("kind", KINDS)
def test_copies(case, kind, how):
    tried = case(kind)
    before, copied = tried.reference(), COPIES[how](tried.predictor)
    CHANGES["load_state_dict"](tried.model)
    assert tried.is_of(before, copied)
    if kind == "bound":
        CHANGES["sgd"](copied.model)
        assert tried.is_of(tried.reference(copied.model), copied) and tried.is_of(tried.reference())
    else:
        copied.refresh(tried.bound)
        assert tried.is_of(tried.reference(), copied) and tried.is_of(before)


@pytest.mark.parametrize("kind", KINDS)
def test_stacked_copies(case, specialised, fitted, scenes, kind):
    tried = case(kind)
    members = [fitted(seed).bind(scenes["pendulum"]) if kind == "bound" else specialised(kind, seed) for seed in (0, 1)]
    expected = torch.stack([tried.reference(fitted(seed))[:3] for seed in (0, 1)])
    rollout = Rollout(members[0])
    given = tried.state[:3], tried.actions[:3]
    stacked = stack_module_state([Rollout(member) for member in members])
    found = torch.vmap(lambda *weights: functional_call(rollout, weights, given))(*stacked)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    together = torch.stack([TensorDict.from_module(member).data for member in members])

    def call(weights: TensorDict) -> Tensor:
        with weights.to_module(members[0]):
            return members[0].rollout(*given)[0]

    torch.testing.assert_close(torch.vmap(call)(together), expected, rtol=0, atol=1e-9)
    assert tried.is_of(expected_of(tried), members[0])


def expected_of(tried: Case) -> Tensor:
    return tried.reference()


# Derivatives


def cost(
    tried: Case, predictor: Predictor, count: int = 2, steps: int = 2
) -> tuple[Callable[[Tensor], Tensor], Tensor]:
    state, actions = tried.state[:count], tried.actions[:count, :steps].clone()
    return lambda actions: predictor.rollout(state, actions)[0].sin().sum(), actions


@pytest.mark.parametrize("kind", KINDS)
def test_second_derivatives(case, kind):
    tried = case(kind)
    reference, at = cost(tried, tried.model.bind(tried.bound.scene, reference=True))
    function, _ = cost(tried, tried.predictor)
    expected, along = hessian(reference, at), torch.randn_like(at)

    def of_gradient(allow_unused: bool = False) -> Tensor:
        leaf = at.clone().requires_grad_()
        (first,) = torch.autograd.grad(function(leaf), leaf, create_graph=True)
        return torch.autograd.grad((first * along).sum(), leaf, allow_unused=allow_unused)[0]

    wanted = (expected.flatten(3).flatten(0, 2) @ along.flatten()).view_as(at)
    # By transforms, also as a model's first call.
    torch.testing.assert_close(torch.func.hessian(function)(at), expected)
    ways = (
        lambda: hvp(function, at, along)[1],
        of_gradient,
        lambda: of_gradient(allow_unused=True),
        lambda: torch.einsum("btabsc,bsc->bta", hessian(function, at), along),
    )
    for way in ways:
        if kind == "native":
            with pytest.raises(RuntimeError, match="first order.*executor='eager'.*reference=True"):
                way()
        else:
            torch.testing.assert_close(way(), wanted)


def test_second_derivatives_of_many(case):
    """Second derivatives of native rollouts (many rows) are refused, never left out."""
    tried = case("bound")
    function, at = cost(tried, tried.bound, MANY, 10)
    leaf = at.requires_grad_()
    (first,) = torch.autograd.grad(function(leaf), leaf, create_graph=True)
    for allow_unused in (False, True):
        with pytest.raises(RuntimeError, match="first order.*reference=True"):
            torch.autograd.grad(first.sum(), leaf, allow_unused=allow_unused, retain_graph=True)
    weight = next(tried.model.core.parameters())
    (first,) = torch.autograd.grad(function(leaf), weight, create_graph=True)
    with pytest.raises(RuntimeError, match="first order.*reference=True"):
        torch.autograd.grad(first.sum(), weight, allow_unused=True)


@pytest.mark.slow
@pytest.mark.parametrize("transform", [torch.func.jacrev, torch.func.jacfwd])
@pytest.mark.parametrize("kind", KINDS)
def test_jacobians(case, kind, transform):
    tried = case(kind)
    reference, at = (
        lambda predictor: lambda actions: predictor.rollout(tried.state[:2], actions)[0],
        tried.actions[:2, :2],
    )
    expected = torch.autograd.functional.jacobian(reference(tried.model.bind(tried.bound.scene, reference=True)), at)
    torch.testing.assert_close(transform(reference(tried.predictor))(at), expected)
    torch.testing.assert_close(torch.autograd.functional.jacobian(reference(tried.predictor), at), expected)
    assert tried.is_of(tried.reference())


@pytest.mark.parametrize("count", [2, MANY])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_in_weights(case, kind, count):
    """A bound model has the reference's gradients; a specialised one has none: autograd raises its own error."""
    tried = case(kind)
    results = []
    for predictor in (tried.model.bind(tried.bound.scene, reference=True), tried.predictor):
        function, at = cost(tried, predictor, count, 10)
        weights = list(tried.model.core.parameters())
        if predictor is not tried.bound and predictor is tried.predictor:
            with pytest.raises(RuntimeError, match="does not require grad"):
                torch.autograd.grad(function(at), weights)
            return
        results.append(torch.autograd.grad(function(at), weights, allow_unused=True))
    for expected, found in zip(*results, strict=True):
        assert (expected is None) == (found is None)
        if expected is not None:
            torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, MANY])
@pytest.mark.parametrize("kind", KINDS)
def test_forward_mode(case, kind, count):
    tried = case(kind)
    state, actions = tried.state[:count], tried.actions[:count]
    along, (first, *_) = torch.ones_like(actions), tried.model.core.parameters()
    reference = tried.model.bind(tried.bound.scene, reference=True)

    def tangent(predictor, of_weight: bool) -> Tensor:
        with torch.autograd.forward_ad.dual_level():
            given = torch.autograd.forward_ad.make_dual(actions, along)
            if not of_weight:
                return torch.autograd.forward_ad.unpack_dual(predictor.rollout(state, given)[0]).tangent
            name = next(name for name, weight in predictor.named_parameters() if weight is first)
            dual = torch.autograd.forward_ad.make_dual(first.detach(), torch.ones_like(first))
            out = functional_call(Rollout(predictor), {f"predictor.{name}": dual}, (state, actions))
            return torch.autograd.forward_ad.unpack_dual(out).tangent

    for of_weight in (False, True)[: 1 + (kind == "bound")]:
        torch.testing.assert_close(
            tangent(tried.predictor, of_weight), tangent(reference, of_weight), rtol=1e-7, atol=1e-9
        )


# Modes


@pytest.mark.parametrize("kind", KINDS)
def test_modes_without_gradients(case, kind):
    tried = case(kind)
    before, leaf = tried.reference(), tried.actions.clone().requires_grad_()
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            states = tried.predictor.rollout(tried.state, leaf)[0]
            assert not states.requires_grad and states.is_inference() == (mode is torch.inference_mode)
            torch.testing.assert_close(states, before, rtol=0, atol=1e-9)
            given = tried.state.clone(), tried.actions.clone()
        with torch.no_grad():
            torch.testing.assert_close(tried.predictor.rollout(*given)[0], before, rtol=0, atol=1e-9)
        loss = tried.predictor.rollout(tried.state, leaf)[0].sin().sum()
        loss.backward()
        assert leaf.grad is not None and leaf.grad.abs().sum() > 0


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("kind", KINDS)
def test_autocast(case, kind, dtype):
    tried = case(kind)
    tried.model.float()
    predictor = tried.bound if kind == "bound" else specialize(tried.bound, executor=kind)
    for count in (3, MANY):
        given, leaf = tried.state[:count], tried.actions[:count].clone().requires_grad_()
        found = []
        for enabled in (False, True):
            with torch.autocast("cpu", dtype, enabled=enabled):
                made = predictor if kind == "bound" else specialize(tried.bound, executor=kind)
                states = [made.rollout(given, leaf)[0], made.step(given, leaf[:, 0])[0]]
            found.append([*states, *(torch.autograd.grad(each.sin().sum(), leaf)[0] for each in states)])
        assert all(map(torch.equal, *found))


@pytest.mark.parametrize("kind", KINDS)
def test_another_default_dtype(case, kind):
    tried = case(kind)
    before = tried.reference()
    torch.set_default_dtype(torch.float64)
    try:
        made = tried.bound if kind == "bound" else specialize(tried.bound, executor=kind)
        single = copy.deepcopy(tried.model).float().bind(tried.bound.scene)
        single = single if kind == "bound" else specialize(single, executor=kind)
        assert tried.is_of(before) and tried.is_of(before, made) and single.dtype == torch.float32
        torch.testing.assert_close(single.rollout(tried.state, tried.actions)[0].detach(), before, rtol=1e-4, atol=1e-4)
        leaf = tried.actions.float().requires_grad_()
        tried.predictor.rollout(tried.state.float(), leaf)[0].sum().backward()
        assert leaf.grad is not None and leaf.grad.dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


# Compilers


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("kind", KINDS)
def test_compiled(case, kind):
    """Compiled rollouts follow changed weights, as others do. Two steps would take twice the time to compile."""
    tried = case(kind)
    before = tried.reference()
    compiled = torch.compile(Rollout(tried.predictor), fullgraph=True, backend="aot_eager")
    for count in (3, MANY):
        found = compiled(tried.state[:count], tried.actions[:count, :1])
        torch.testing.assert_close(found.detach(), before[:count, :2], rtol=0, atol=1e-9)
    CHANGES["adam, fused"](tried.model)
    now = tried.reference()
    found = compiled(tried.state, tried.actions[:, :1]).detach()
    torch.testing.assert_close(found, (now if kind == "bound" else before)[:, :2], rtol=0, atol=1e-9)
    if kind != "bound":
        tried.predictor.refresh(tried.bound)  # pyright: ignore[reportAttributeAccessIssue]
        found = compiled(tried.state, tried.actions[:, :1])
        torch.testing.assert_close(found, now[:, :2], rtol=0, atol=1e-9)
    leaf = tried.actions[:, :1].clone().requires_grad_()
    gradients = [
        torch.autograd.grad(each(tried.state, leaf).sin().sum(), leaf)[0]
        for each in (compiled, Rollout(tried.predictor))
    ]
    torch.testing.assert_close(*gradients)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:No complete tensor found")  # torch's, of constants that share memory
@pytest.mark.parametrize("kind", KINDS)
def test_exported(case, kind, tmp_path):
    """A file keeps the weights that it was made with; a bound model's program in memory shares the model's."""
    tried = case(kind)
    tried.model.requires_grad_(False)
    before, given = tried.reference(), (tried.state, tried.actions[:, :2])
    batch = torch.export.Dim("batch")
    program = torch.export.export(Rollout(tried.predictor), given, dynamic_shapes=({0: batch}, {0: batch}))
    torch.export.save(program, tmp_path / "program.pt2")
    write_data(tried.model)
    now = tried.reference() if kind == "bound" else before
    for each, expected in ((program, now), (torch.export.load(tmp_path / "program.pt2"), before)):
        for count in (MANY, 7):
            found = each.module()(*(part[:count] for part in given))
            torch.testing.assert_close(found, expected[:count, :3], rtol=0, atol=1e-9)


# Processes


def _predict_and_change(queue, predictor: Predictor, given: tuple[Tensor, Tensor]) -> None:
    torch.set_num_threads(1)
    with torch.no_grad():
        queue.put(predictor.rollout(*given)[0].numpy())
        for each in (*predictor.parameters(), *(b for name, b in predictor.named_buffers() if "core" in name)):
            if each.is_floating_point():
                each.mul_(0.9)
        queue.put(predictor.rollout(*given)[0].numpy())


@pytest.mark.slow
@pytest.mark.usefixtures("quick_processes")
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(
    ("kind", "method"),
    [*((kind, "fork") for kind in KINDS), ("bound", "forkserver"), ("native", "spawn"), ("eager", "forkserver")],
)
def test_other_processes(case, kind, method, shared):
    """Processes predict the same; all see changes of shared memory."""
    tried = case(kind)
    before = tried.reference()
    if shared:
        tried.predictor.share_memory()
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    given = tried.state, tried.actions
    process = context.Process(target=_predict_and_change, args=(queue, tried.predictor, given))
    process.start()
    first, found = (torch.from_numpy(queue.get(timeout=300)) for _ in range(2))
    process.join()
    assert process.exitcode == 0
    torch.testing.assert_close(first, before, rtol=0, atol=1e-9)
    assert (found - before).abs().max() > 1e-6
    # What is sent to a process that is started anew lies in shared memory, too.
    assert tried.is_of(found if shared or method != "fork" else before)


# Collectors


class Cost(nn.Module):
    """A reward that a planner's actions depend on."""

    def forward(self, state, action, next_state, task=None):
        return -(next_state[..., 1, 11:12] - 0.5).square() - 0.01 * action.square()


def make_env(scene):
    from torchrl_gn.envs import SceneEnv, batched

    return batched(SceneEnv(scene, Cost(), seed=0), 4)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_processes")
@pytest.mark.parametrize("kind", KINDS)
def test_planners_in_workers_take_new_weights(fitted, scenes, kind):
    from torchrl.collectors import MultiSyncCollector

    from torchrl_gn.envs import ModelEnv
    from torchrl_gn.planners import GradientPlanner

    scene, model = scenes["pendulum"], fitted().float()
    bound = model.bind(scene)
    predictor = bound if kind == "bound" else specialize(bound, executor=kind)
    options = {"horizon": 4, "iterations": 1, "warm_up": 2, "samples": 4, "seed": 0}
    planner = GradientPlanner(ModelEnv(predictor, Cost()), **options)
    collector = MultiSyncCollector(
        [functools.partial(make_env, scene)],
        planner,
        frames_per_batch=40,
        total_frames=120,
        auto_register_policy_transforms=True,
    )
    try:
        count = 0
        for batch in collector:
            batch = batch.reshape(-1, batch.shape[-1])
            # A row's plan is what the planner wrote: one that goes on from it draws nothing.
            before = batch[:, 1:].select("state").set("plan", batch[:, :-1]["plan"].clone()).reshape(-1)
            made = model.bind(scene) if kind == "bound" else specialize(model.bind(scene), executor=kind)
            check = GradientPlanner(ModelEnv(made, Cost()), **options)
            actions = batch[:, 1:]["action"].reshape(-1, 1)
            torch.testing.assert_close(check(before)["action"], actions, rtol=0, atol=1e-4)
            CHANGES["adam, fused"](model)
            if kind != "bound":
                predictor.refresh(bound)  # pyright: ignore[reportAttributeAccessIssue]
            collector.update_policy_weights_()
            count += 1
    finally:
        collector.shutdown()
    assert count == 3
