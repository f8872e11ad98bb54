"""State maths that the native executor traces: features of one's own, large scenes, every scene of the zoo."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
import torch
from torch import nn

from torchrl_gn.dynamics import BodyState, BoundPredictor, Contacts, Controls, ForwardModel, JointAxes, specialize
from torchrl_gn.dynamics.executors.native import executor as native_executor
from torchrl_gn.dynamics.executors.native import state_maths
from torchrl_gn.dynamics.executors.native.tape import assemble
from torchrl_gn.dynamics.features import Feature

from .. import zoo
from ..sizes import SMALL
from .native import ROOT, equal, vjp, with_compiler

pytestmark = with_compiler

ZOO = sorted(path.stem for path in (ROOT / "tests/zoo").glob("*.xml"))


# Features of one's own


def with_feature(fit, scene, function, **options) -> BoundPredictor:
    """Bound predictor whose nodes also see ``function(state)``, ``[*B, N, 1]``."""

    class Bound(nn.Module):
        def forward(self, inputs):
            return function(inputs.canonical.state)

    @dataclass(frozen=True)
    class Own(Feature):
        part: ClassVar[Literal["nodes", "edges"]] = "nodes"

        def size(self, layout):
            return 1

        def bind(self, scene, layout, canonicalizer):
            return Bound()

    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, features=(BodyState(), Controls(), Own()), **SMALL, **options)
    return fit(model, scene).double().bind(scene)


SKEW = torch.tensor([[2.0, 1, 0], [-1, 2, 1], [0.5, 0, 1]], dtype=torch.float64)
REASONS = {
    "erf": (lambda s: s[..., 7:8].erf(), "erf"),
    "branch": (lambda s: s[..., 7:8] if (s[..., 7] > 0).any() else s[..., 8:9], "has no scalar form"),
    "item": (lambda s: s[..., 7:8] * s.sum().item(), "_local_scalar_dense"),
    "list": (lambda s: s[..., 7:8] * np.sum(s.tolist()), "tolist"),
    "unsymmetric": (
        lambda s: torch.linalg.solve(SKEW, s[..., 7:10, None])[..., :1, 0],
        "native step differs from torch's by .* of the change",
    ),
    "symmetric": (lambda s: torch.linalg.solve(SKEW @ SKEW.T, s[..., 7:10, None])[..., :1, 0], None),
    "norm": (lambda s: s[..., 7:10].norm(dim=-1, keepdim=True), None),
    "largest": (lambda s: s[..., 7:10].abs().amax(-1, keepdim=True), None),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", REASONS)
def test_features_of_ones_own(fit, inputs, kind):
    function, reason = REASONS[kind]
    bound = with_feature(fit, zoo.load("arm"), function)
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(predictor, 4)
    found, expected = predictor.rollout(state, actions)[0], eager.rollout(state, actions)[0]
    if reason is None:
        assert predictor.reason is None
        assert (found - expected).norm() <= 1e-12 * expected.norm()
        return
    assert torch.equal(found, expected)
    given = predictor.reason
    assert given is not None and re.search(reason, given) and "\n" not in given
    assert f"native, but here by torch: {given}" in str(predictor)
    predictor.refresh(bound)
    assert torch.equal(predictor.rollout(state, actions)[0], expected) and predictor.reason == given


@pytest.mark.slow
def test_state_maths_with_too_many_registers(wide, quick, inputs, calls, monkeypatch):
    eager = quick(executor="eager")
    state, actions = inputs(eager, 3)
    lifted = state + torch.eye(13, dtype=torch.float64)[2]

    assembled = calls(state_maths, "assemble")
    specialize(wide())
    registers = [assemble(*each).registers for each in assembled]
    assert len(registers) == 4  # two state maths and their gradients
    most = "torchrl_gn.dynamics.executors.native.tape._MOST_REGISTERS"
    monkeypatch.setattr(most, max(registers[:2]))  # enough for the scene's states, not for others
    predictor = specialize(wide())
    assert predictor.reason is None and max(registers[2:]) > max(registers[:2])
    assert equal(vjp(predictor, state, actions), vjp(quick(), state, actions))
    mixed, both = torch.cat((lifted, state)), torch.cat((actions, actions))
    for start, given in ((lifted, actions), (mixed, both)):
        for found, expected in zip(vjp(predictor, start, given), vjp(eager, start, given), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    monkeypatch.setattr(most, 50)
    predictor = specialize(wide())
    assert equal(vjp(predictor, state, actions), vjp(eager, state, actions))  # without packed weights
    assert re.search(r"needs \d+ registers", predictor.reason)


# Scenes


def zoo_cases() -> list:
    few = ("arm", "everything", "odd", "soft", "tumbler", "parallel_hinges", "quadrotor", "machine")
    return [pytest.param(name, marks=[] if name in few else pytest.mark.slow) for name in ZOO]


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo_cases())
def test_every_scene_is_traced(make_model, moved, random_states, random_actions, name):
    scene = zoo.load(name)
    axes = () if scene.state_size != 13 else (JointAxes().resolved(scene), Contacts())
    for options in ({}, {"features": (BodyState(encoding="quaternion"), Controls(), *axes), "integrate": False}):
        if options and not axes:
            continue
        bound = make_model(scene, **options).double().requires_grad_(False).bind(scene)
        predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
        state = torch.cat((moved(bound, 3), random_states(scene, 2, seed=3)))  # for both state maths
        actions = random_actions(scene, 5, 2, seed=3)
        some = random_states(scene, 20)
        varies = (some != some[0]).any(0)
        expected, found = (vjp(each, state, actions) for each in (eager, predictor))
        assert predictor.reason is None
        for index, (wanted, got) in enumerate(zip(expected, found, strict=True)):
            wanted, got = (each * varies if index == 1 else each for each in (wanted, got))
            assert (got - wanted).norm() <= 1e-10 * wanted.norm()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["humanoid", "walker", "hopper", "swimmer"])
def test_scenes_of_the_suite_are_traced(make_model, moved, random_states, random_actions, name):
    suite = pytest.importorskip("dm_control.suite")
    from torchrl_gn.scenes import load_scene

    scene = load_scene(Path(suite.__file__).with_name(f"{name}.xml")) if name != "swimmer" else load_scene("swimmer15")
    bound = make_model(scene).double().bind(scene)
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    state, action = torch.cat((moved(bound, 2), random_states(scene, 2))), random_actions(scene, 4, seed=3)
    found, expected = predictor.step(state, action)[0], eager.step(state, action)[0]
    assert predictor.reason is None
    assert (found - expected).norm() <= 1e-10 * (expected - state).norm()


@pytest.fixture(params=[1, 10**9])
def large(request, monkeypatch) -> bool:
    """Whether all scenes are large, or none."""
    monkeypatch.setattr(native_executor, "LARGE", request.param)
    return request.param == 1


@pytest.mark.slow
def test_large_scenes_are_traced_once_for_all_states(make_model, moved, random_states, random_actions, large):
    """Only the world's pose is constant beside a free body, so both state maths are about as long."""
    from torchrl_gn.scenes import load_scene

    link = '<geom size=".1"/><body pos=".3 0 0"><joint name="j" axis="0 1 0"/><geom size=".1"/></body>'
    tree, motor = f'<body pos="0 0 1"><freejoint/>{link}</body>', '<motor joint="j" ctrlrange="-1 1"/>'
    scene = load_scene(f"<mujoco><worldbody>{tree}</worldbody><actuator>{motor}</actuator></mujoco>")
    bound = make_model(scene).double().bind(scene)
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    executor = native_executor.NativeExecutor(bound.program())
    assert sum(place >= 0 for place in executor.structure[5:7].tolist()) == (1 if large else 2)
    state, action = torch.cat((moved(bound, 2), random_states(scene, 2))), random_actions(scene, 4, seed=3)
    found, expected = predictor.step(state, action)[0], eager.step(state, action)[0]
    assert predictor.reason is None
    assert (found - expected).norm() <= 1e-10 * (expected - state).norm()


@pytest.mark.usefixtures("large")
def test_planar_state_maths_is_traced_apart(make_model):
    from torchrl_gn.scenes import load_scene

    scene = load_scene("swimmer3")
    executor = native_executor.NativeExecutor(make_model(scene).bind(scene).program())
    assert (executor.structure[5:7] >= 0).all()
