"""The compiled executor: recompilations and refusals."""

from __future__ import annotations

import copy

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors.compiled import CompiledExecutor
from torchrl_gn.networks import CORES, Core

from ..compiling import NEW_TORCH, compiles, no_compiler
from ..sizes import SMALL

MODELS = [SMALL, {"core": "recurrent", "hidden_state": (3, 4, 5), **SMALL}]


def change_in_place(model: ForwardModel) -> None:
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(1.5)


@pytest.fixture
def compilations(monkeypatch) -> list:
    """Functions that were compiled, a step and its gradient of each program; they run without a compiler."""
    made = []
    monkeypatch.setattr(
        "torchrl_gn.dynamics.executors.compiled._compile", lambda function: made.append(function) or function
    )
    return made


@compiles
@pytest.mark.parametrize("options", MODELS)
def test_compiled_code_is_kept_for_other_weights(
    scenes, make_model, random_states, random_actions, compilations, options
):
    scene = scenes["pendulum"]
    model = make_model(scene, **options)
    bound = model.bind(scene)
    quick = specialize(bound, executor="compiled")
    assert isinstance(quick.executor, CompiledExecutor) and quick.reason is None
    assert quick.fixed_batch and not bound.fixed_batch and not specialize(bound).fixed_batch
    state, action = random_states(scene, 3), random_actions(scene, 3)
    before = quick.step(state, action)[0]
    change_in_place(model)
    assert torch.equal(quick.step(state, action)[0], before)
    quick.refresh(bound)
    after = quick.step(state, action)[0]
    assert not torch.equal(after, before)
    torch.testing.assert_close(after, bound.step(state, action)[0].detach())
    leaf = action.clone().requires_grad_()
    found, expected = (torch.autograd.grad(each.step(state, leaf)[0].sin().sum(), leaf)[0] for each in (quick, bound))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    assert len(compilations) == 2
    twin = copy.deepcopy(quick)  # which compiles for itself
    assert torch.equal(twin.step(state, action)[0], after) and len(compilations) == 4


@compiles
def test_a_gradient_is_of_the_weights_that_predicted(scenes, make_model, random_states, random_actions, compilations):
    scene = scenes["pendulum"]
    bound = make_model(scene).bind(scene)
    quick = specialize(bound, executor="compiled")
    state, leaf = random_states(scene, 3), random_actions(scene, 3).requires_grad_()
    after = quick.step(state, leaf)[0]
    quick.refresh(bound)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        after.sum().backward()
    first = torch.autograd.grad(quick.step(state, leaf)[0].square().sum(), leaf, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("options", MODELS)
def test_compiled_rollouts_and_their_gradients(scenes, make_model, random_states, random_actions, options):
    scene = scenes["pendulum"]
    model = make_model(scene, **options)
    bound, quick = model.bind(scene), specialize(model.bind(scene), executor="compiled")
    model.requires_grad_(False)
    state, actions = random_states(scene, 2, scale=0.1), random_actions(scene, 2, 3)

    def vjp(model):
        leaves = [value.clone().requires_grad_() for value in (state, actions)]
        states = model.rollout(*leaves)[0]
        return [states.detach(), *torch.autograd.grad(states[:, -1].square().sum(), leaves)]

    for expected, got in zip(vjp(bound), vjp(quick), strict=True):
        assert got.dtype == expected.dtype
        assert (got - expected).norm() <= 1e-5 * expected.norm()
    # Compiling takes a minute: other strides, or a gradient that is wanted, must not need it again.
    strided = state.mT.contiguous().mT
    with torch.compiler.set_stance("fail_on_recompile"):
        torch.testing.assert_close(quick.step(strided, actions[:, 0])[0], bound.step(state, actions[:, 0])[0])
        quick.step(strided.requires_grad_(), actions[:, 1])[0].sum().backward()
    # Other weights of the same shapes are used without compiling again.
    change_in_place(model)
    quick.refresh(bound)
    with torch.compiler.set_stance("fail_on_recompile"):
        torch.testing.assert_close(quick.step(state, actions[:, 0])[0], bound.step(state, actions[:, 0])[0])


@pytest.mark.skipif(NEW_TORCH, reason="this torch is new enough")
def test_compiling_with_an_old_torch_is_refused(scenes, make_model):
    with pytest.raises(RuntimeError, match="compiling needs torch 2.13 or newer"):
        specialize(make_model(scenes["swimmer6"]).bind(scenes["swimmer6"]), executor="compiled")


@pytest.mark.skipif(not NEW_TORCH, reason="torch is too old to compile")
@pytest.mark.parametrize("key", [None, "parameters"])
def test_compiling_without_a_compiler_is_refused(scenes, make_model, key):
    bound = make_model(scenes["swimmer6"]).bind(scenes["swimmer6"], parameters_key=key)
    missing = pytest.raises(FileNotFoundError, match="compiling needs a C\\+\\+ compiler: install g\\+\\+")
    with no_compiler(), missing:
        specialize(bound, executor="compiled")


@compiles
def test_a_core_without_fold_is_not_compiled(scenes, monkeypatch):
    class Unfolded(CORES["gn"]):
        fold = Core.fold

    monkeypatch.setitem(CORES, "unfolded", Unfolded)
    scene = scenes["pendulum"]
    bound = ForwardModel.for_scene(scene, core="unfolded", **SMALL).bind(scene)
    with pytest.raises(TypeError, match=r"Unfolded has no fold\(\).*use executor='eager'"):
        specialize(bound, executor="compiled")
    with pytest.raises(
        ValueError, match=r"executor='nativ' is not known; use one of \['eager', 'compiled', 'native'\]"
    ):
        specialize(bound, executor="nativ")
    with pytest.raises(TypeError, match="dtype='bf16' must be a torch.dtype, such as torch.bfloat16"):
        specialize(bound, dtype="bf16")
