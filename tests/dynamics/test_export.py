"""Exported programs, run without torchrl_gn: by another Python, or in C."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import sys

import pytest
import torch

from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.dynamics import Ensemble, export_c, export_step, specialize
from torchrl_gn.dynamics.executors.native.build import instruction_flags
from torchrl_gn.policies import StatePolicy
from torchrl_gn.scenes import load_scene

COMPILER = shutil.which("g++")
with_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no g++ here")

ALONE = """
import sys
sys.modules["torchrl_gn"] = None  # importing it fails
import torch
path, given, found = sys.argv[1:]
step = torch.export.load(path).module()
given = torch.load(given)
torch.save([step(state, action) for state, action in given], found)
"""


@pytest.mark.slow
def test_a_program_predicts_as_its_model_for_any_batch_without_the_package(
    scenes, make_model, random_states, random_actions, tmp_path
):
    scene = scenes["pendulum"]
    bound = make_model(scene).bind(scene)
    path = export_step(bound, tmp_path / "step.pt2")
    given = [(random_states(scene, count), random_actions(scene, count).float()) for count in (1, 2, 7)]
    torch.save(given, tmp_path / "given.pt")
    arguments = [str(path), str(tmp_path / "given.pt"), str(tmp_path / "found.pt")]
    subprocess.run([sys.executable, "-c", ALONE, *arguments], check=True, cwd=tmp_path)
    changed = 0.0
    for (state, action), found in zip(given, torch.load(tmp_path / "found.pt"), strict=True):
        expected = specialize(bound).step(state, action)[0]
        changed = (expected - state).norm()
        assert (found - expected).norm() <= 1e-5 * changed
    assert changed > 0
    extra = {"scene.json": ""}
    torch.export.load(path, extra_files=extra)
    about = json.loads(extra["scene.json"])
    assert (about["scene"], about["nodes"], about["actions"]) == ("pendulum", list(scene.node_names), 1)


def test_a_model_of_many_variants_is_refused(scenes, make_model, tmp_path):
    scene = scenes["pendulum"]
    with pytest.raises(ValueError, match="physical parameters of their own"):
        export_step(make_model(scene).bind(scene, parameters_key="parameters"), tmp_path / "step.pt2")
    assert not list(tmp_path.iterdir())


def build(*arguments) -> None:
    subprocess.run([str(COMPILER), *map(str, arguments)], check=True, capture_output=True)


def pointer(tensor: torch.Tensor) -> ctypes.c_void_p:
    assert tensor.dtype == torch.float64 and tensor.is_contiguous()
    return ctypes.c_void_p(tensor.data_ptr())


def steps_of(library, state, actions, threads=1):
    """Status and states of a rollout in C."""
    states = torch.full((len(state), actions.shape[1] + 1, *state.shape[1:]), torch.nan, dtype=torch.float64)
    status = library.twin_rollout(*actions.shape[:2], threads, pointer(state), pointer(actions), pointer(states))
    return status, states


@with_compiler
@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        pytest.param("swimmer6", torch.float64, marks=pytest.mark.slow),
        pytest.param("jaco", torch.float32, marks=pytest.mark.slow),
    ],
)
def test_c_functions_are_the_native_executor_bit_for_bit(fit, make_model, random_actions, tmp_path, name, dtype):
    scene = load_scene(name)
    bound = fit(make_model(scene, fitted=False).to(dtype), scene).bind(scene)
    folder = export_c(bound, tmp_path / "twin")
    assert sorted(file.name for file in folder.iterdir()) == ["main.c", "twin.cpp", "twin.h"]
    flags = ["-Wall", "-Wextra", "-Werror", "-Wno-psabi"]
    # As the executor is built: less optimised, gradients are others in their last bits.
    shared = ("-shared", "-fPIC", folder / "twin.cpp", "-o", tmp_path / "twin.so")
    build("-O3", "-std=c++17", *flags, *instruction_flags(), *shared)
    library = ctypes.CDLL(str(tmp_path / "twin.so"))

    rest = torch.tensor((ctypes.c_double * (13 * scene.num_nodes)).in_dll(library, "twin_rest")[:], dtype=torch.float64)
    rest = rest.reshape(1, -1, 13)
    native = specialize(bound)
    assert native.reason is None
    for count, steps, threads, lifted in ((1, 1, 1, 0), (7, 3, 1, 0), (30, 2, 2, 0), (1, 2, 1, 1), (30, 2, 2, 3)):
        state = Simulator(scene).observe(sample_start_states(scene, count, 0))
        if lifted:
            state[::lifted, 0, 2] = 1.0  # the world cannot move: other state maths, of all samples or some
        actions = random_actions(scene, count, steps).requires_grad_()
        expected, _ = native.rollout(state.requires_grad_(), actions)
        status, states = steps_of(library, state, actions, threads)
        assert status == 0 and torch.equal(states, expected)
        weights = torch.randn(expected.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        found = torch.full_like(state, torch.nan), torch.full_like(actions, torch.nan)
        given = (states, actions, weights, *found)
        assert library.twin_rollout_gradient(count, steps, threads, *map(pointer, given)) == 0
        for got, wanted in zip(found, torch.autograd.grad((expected * weights).sum(), (state, actions)), strict=True):
            assert wanted.norm() > 0 and torch.equal(got, wanted)
        after = torch.empty_like(state[0])
        assert library.twin_step(*map(pointer, (state[0], actions[0, 0].contiguous(), after))) == 0
        assert torch.equal(after, expected[0, 1])

    broken = rest.clone()
    broken[:, 1, 0] = torch.nan
    status, states = steps_of(library, broken, torch.zeros(1, 1, scene.num_actions, dtype=torch.float64))
    assert status == 0 and states[:, 1].isnan().any()


@pytest.mark.slow
@with_compiler
def test_a_specialised_model_is_exported_as_it_is(scenes, make_model, tmp_path):
    scene = scenes["pendulum"]
    model = make_model(scene)
    native = specialize(model.bind(scene))
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(1.5)
    texts = [
        (export_c(each, tmp_path / name / "step") / "step.cpp").read_text()
        for name, each in (
            ("kept", native),
            ("new", model.bind(scene)),
            ("wide", specialize(model.bind(scene)).double()),
        )
    ]
    assert texts[0] != texts[1] and "const float WEIGHTS" in texts[0] and "const double WEIGHTS" in texts[2]
    native.refresh(model.bind(scene))
    assert (export_c(native, tmp_path / "again" / "step") / "step.cpp").read_text() == texts[1]


@pytest.mark.slow
def test_c_says_where_it_knows_no_state_maths(scenes, make_model, random_actions, tmp_path, monkeypatch):
    """A model whose maths for other states has no scalar form or too many registers."""
    scene = scenes["swimmer6"]
    bound = make_model(scene).bind(scene)
    monkeypatch.setattr("torchrl_gn.dynamics.executors.native.tape._MOST_REGISTERS", 1000)
    assert (folder := export_c(bound, tmp_path / "twin")).exists()
    words = (folder / "twin.cpp").read_text().split("STRUCTURE[] = {")[1].split("}")[0].replace("\n", " ").split(",")
    assert int(words[6]) == -1 and int(words[5]) > 0


@with_compiler
@pytest.mark.slow
def test_the_example_is_c_and_runs_as_its_header_says(scenes, make_model, tmp_path):
    scene = scenes["falling"]  # no action
    folder = export_c(make_model(scene).bind(scene), tmp_path / "falling")
    build("-std=c++17", folder / "falling.cpp", folder / "main.c", "-o", tmp_path / "example")
    printed = subprocess.run([tmp_path / "example"], check=True, capture_output=True, text=True).stdout
    assert len(printed.splitlines()) == scene.num_nodes
    strict = ("-x", "c", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
    build(*strict, "-c", folder / "main.c", "-o", tmp_path / "main.o")


@pytest.mark.parametrize("export", [export_step, export_c])
def test_models_that_are_no_single_step_are_refused(scenes, make_model, tmp_path, export):
    model, ensemble = make_model(scenes["pendulum"]), Ensemble([make_model(scenes["pendulum"], seed=s) for s in (0, 1)])
    with pytest.raises(TypeError, match=r"ForwardModel is not bound to a scene: use model.bind\(scene\)"):
        export(model, tmp_path / "step")
    with pytest.raises(TypeError, match="An ensemble cannot be exported whole: export each of its members"):
        export(ensemble.bind(scenes["pendulum"]), tmp_path / "step")
    with pytest.raises(TypeError, match="A StatePolicy is not a forward model; torch.export.export exports policies"):
        export(StatePolicy(scenes["pendulum"]), tmp_path / "step")
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
def test_c_refuses_what_the_native_executor_cannot_run(scenes, make_model, tmp_path):
    scene = scenes["pendulum"]
    bound = make_model(scene).bind(scene)
    with pytest.raises(TypeError, match="products in bfloat16 are not written out"):
        export_c(specialize(bound, executor="eager", dtype=torch.bfloat16), tmp_path / "step")
    with pytest.raises(TypeError, match="recurrent"):
        export_c(make_model(scene, core="recurrent", hidden_state=(1, 1, 1)).bind(scene), tmp_path / "step")
    with pytest.raises(ValueError, match="physical parameters of their own"):
        export_c(make_model(scene).bind(scene, parameters_key="parameters"), tmp_path / "step")
    with pytest.raises(ValueError, match="'my-model' is no C identifier"):
        export_c(bound, tmp_path / "my-model")
    with pytest.raises(TypeError, match="specialised for another executor"):
        export_c(specialize(bound, executor="eager"), tmp_path / "step")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@with_compiler
@pytest.mark.parametrize("room", [1, 20_000])
def test_a_full_disk_leaves_what_was_there(scenes, make_model, tmp_path, files_end_at, room):
    """torch's own file writer would end the process."""
    model = make_model(scenes["pendulum"]).bind(scenes["pendulum"])
    (path := tmp_path / "step.pt2").write_text("old")
    (folder := tmp_path / "step").mkdir()
    (folder / "step.h").write_text("old")
    native = specialize(model, executor="native")  # which may have to be built first
    for write in lambda: export_step(model, path), lambda: export_c(native, folder):
        with files_end_at(room), pytest.raises(OSError, match="cannot be written: .* free some space"):
            write()
    assert {file.name: file.read_text() for file in tmp_path.rglob("*") if file.is_file()} == {
        "step.pt2": "old",
        "step.h": "old",
    }
