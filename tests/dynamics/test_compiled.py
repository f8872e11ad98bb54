"""The compiled executor: when it compiles again, and what it refuses."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors.compiled import CompiledExecutor
from torchrl_gn.networks import CORES, Core

from ..compiling import NEW_TORCH, compiles
from ..sizes import SMALL

MODELS = [SMALL, {"core": "recurrent", "hidden_state": (3, 4, 5), **SMALL}]


def change_in_place(model: ForwardModel) -> None:
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(1.5)


def run_of(predictor):
    executor = predictor.executor()
    assert isinstance(executor, CompiledExecutor)
    return executor.run


@compiles
def test_compiled_code_is_dropped_where_other_components_vary(scenes, make_model):
    """As many as before, so that all tensors have the same shapes: but their places are in the compiled code."""
    scene = scenes["swimmer6"]
    model = make_model(scene)
    quick, normalizer = specialize(model.bind(scene), executor="compiled"), model.residual_normalizer
    m2 = normalizer.m2.clone()

    def without(component: int, factor: float = 1.0) -> None:
        changed = factor * m2.index_fill(0, torch.tensor(component), 0.0)
        normalizer.load_state_dict({"count": normalizer.count, "mean": normalizer.mean, "m2": changed})

    without(0)
    run = run_of(quick)
    without(0, factor=2.0)
    assert run_of(quick) is run
    without(1, factor=2.0)
    assert run_of(quick) is not run


@compiles
@pytest.mark.parametrize("options", MODELS)
def test_compiled_code_is_kept_for_other_weights(scenes, make_model, options):
    scene = scenes["pendulum"]
    model = make_model(scene, **options)
    quick = specialize(model.bind(scene), executor="compiled")
    assert quick.fixed_batch and not model.bind(scene).fixed_batch and not specialize(model.bind(scene)).fixed_batch
    run, program = run_of(quick), quick.executor().program
    change_in_place(model)
    assert run_of(quick) is run and quick.executor().program is program
    assert program.core.out[0].norm() > 0
    torch.testing.assert_close(program.core.out[0], specialize(model.bind(scene)).executor().program.core.out[0])
    if program.recurrent is not None:
        for kept, weight in zip(program.recurrent.parameters(), model.core.parameters(), strict=True):
            assert torch.equal(kept, weight) and kept is not weight


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("options", MODELS)
def test_compiled_rollouts_and_their_gradients(scenes, make_model, random_states, random_actions, options):
    scene = scenes["pendulum"]
    model = make_model(scene, **options)
    bound, quick = model.bind(scene), specialize(model.bind(scene), executor="compiled")
    model.requires_grad_(False)
    state, actions = random_states(scene, 2, scale=0.1), random_actions(scene, 2, 3)

    def pull(model):
        leaves = [value.clone().requires_grad_() for value in (state, actions)]
        states = model.rollout(*leaves)[0]
        return [states.detach(), *torch.autograd.grad(states[:, -1].square().sum(), leaves)]

    for expected, got in zip(pull(bound), pull(quick), strict=True):
        assert got.dtype == expected.dtype
        assert (got - expected).norm() <= 1e-5 * expected.norm()
    # Compiling takes a minute: other strides, or a gradient that is wanted, must not need it again.
    strided = state.mT.contiguous().mT
    with torch.compiler.set_stance("fail_on_recompile"):
        torch.testing.assert_close(quick.step(strided, actions[:, 0])[0], bound.step(state, actions[:, 0])[0])
        quick.step(strided.requires_grad_(), actions[:, 1])[0].sum().backward()
    # Other weights of the same shapes are used without compiling again, and not by a gradient of the old ones.
    run = run_of(quick)
    leaf = state.clone().requires_grad_()
    old = quick.step(leaf, actions[:, 0])[0]
    change_in_place(model)
    with torch.compiler.set_stance("fail_on_recompile"):
        torch.testing.assert_close(quick.step(state, actions[:, 0])[0], bound.step(state, actions[:, 0])[0])
    assert run_of(quick) is run
    with pytest.raises(RuntimeError, match="weights changed between a prediction and its gradient"):
        old.sum().backward()


@pytest.mark.skipif(NEW_TORCH, reason="this torch is new enough")
def test_compiling_with_an_old_torch_is_refused(scenes, make_model):
    with pytest.raises(RuntimeError, match="compiling needs torch 2.13 or newer"):
        specialize(make_model(scenes["swimmer6"]).bind(scenes["swimmer6"]), executor="compiled")


@pytest.mark.skipif(not NEW_TORCH, reason="torch is too old to compile")
@pytest.mark.parametrize("key", [None, "parameters"])
def test_compiling_without_a_compiler_is_refused(scenes, make_model, key):
    from torch._inductor import config, cpp_builder

    getattr(cpp_builder.get_cpp_compiler, "cache_clear", lambda: None)()
    bound = make_model(scenes["swimmer6"]).bind(scenes["swimmer6"], parameters_key=key)
    missing = pytest.raises(FileNotFoundError, match="compiling needs a C\\+\\+ compiler: install g\\+\\+")
    with config.patch({"cpp.cxx": ("no-such-compiler",)}), missing:
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
