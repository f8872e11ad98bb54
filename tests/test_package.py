"""Rules of the whole package: imports, wording, and public names."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import torchrl_gn

from . import zoo

PACKAGE = Path(torchrl_gn.__file__).parent

FOLDERS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
LATER = (ast.FunctionDef, ast.AsyncFunctionDef)  # what is imported in there is not when the package is
WITH_PILLOW = {"panels.py"}  # imported to draw a video, once Pillow was found
# The names of ``import torchrl_gn``.
PUBLIC = {
    "data": ["collect_trajectories", "create_dataset", "load_dataset", "trajectory_buffer"],
    "dynamics": ["Ensemble", "ForwardModel", "export_c", "export_step", "specialize"],
    "envs": ["ModelEnv", "SceneEnv"],
    "evaluation": ["calibrate", "evaluate_coverage", "evaluate_errors", "rollout_video"],
    "identification": ["IdentifyingModel"],
    "objectives": ["ForwardModelLoss", "IdentificationLoss", "SHACLoss", "SVGLoss"],
    "planners": ["GradientPlanner", "ILQGPlanner", "PlanAhead", "SamplingPlanner"],
    "rewards": ["available_rewards", "make_reward"],
    "scenes": ["load_scene"],
    "training": ["fit", "fit_ensemble", "load_pretrained", "pretrained_names", "save_checkpoint"],
}
NAMES = sorted(name for names in PUBLIC.values() for name in names)
FILES = sorted(PACKAGE.rglob("*.py"))


def module_of(file: Path) -> str:
    """Dotted name of a file's module."""
    return ".".join(("torchrl_gn", *file.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


MODULES = {module_of(file): file for file in FILES}


def imports(tree: ast.AST) -> list[str]:
    """Absolute names of all modules that a file imports, inside functions too."""
    return [name for node in ast.walk(tree) for name in imported(node)]


def imported(node: ast.AST) -> list[str]:
    """Absolute names of the modules that a statement imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    assert node.level == 0 and node.module, "imports are absolute"
    inner = [f"{node.module}.{alias.name}" for alias in node.names]
    return [name if name in MODULES else node.module for name in inner]


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


@pytest.mark.slow
def test_what_is_imported_is_declared():
    """An undeclared import, which a dependency's dependency provides, may fail in a new installation."""
    lines = metadata.requires("torchrl_gn") or []
    needed, optional = (
        {re.split(r"[^\w-]", line)[0] for line in lines if ("extra ==" in line) is extra} for extra in (False, True)
    )
    brought_by = metadata.packages_distributions()
    for file in PACKAGE.rglob("*.py"):
        parsed = ast.parse(file.read_text())
        inside = [node for node in ast.walk(parsed) if isinstance(node, LATER) or is_for_types(node)]
        later = {name for node in inside for name in imports(node)}
        for name in imports(parsed):
            package = name.split(".")[0]
            if package in sys.stdlib_module_names | {"torchrl_gn"}:
                continue
            known = needed | optional if name in later or file.name in WITH_PILLOW else needed
            # Python 3.10 does not find the packages that list no top level.
            distributions = {found.replace("_", "-").lower() for found in brought_by.get(package, [package])}
            assert distributions & known, f"{file.name} imports {name}, which pyproject.toml does not name"


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_importing_everything_is_silent_and_leaves_the_recipes_libraries_alone():
    folders = [f"torchrl_gn.{folder}" for folder in FOLDERS]
    done = run(
        f"import sys, {', '.join(['torchrl_gn', *folders])}\n"
        "wanted = {'hydra', 'omegaconf', 'wandb', 'dm_control', 'gymnasium', 'matplotlib.pyplot', 'viser'}\n"
        "print(sorted(wanted & set(sys.modules)))"
    )
    assert done.returncode == 0, done.stderr
    assert (done.stdout, done.stderr) == ("[]\n", "")


WITHOUT_EXTRAS = """
import sys

for name in (
    "matplotlib", "PIL", "dm_control", "hydra", "omegaconf", "imageio_ffmpeg", "tensorboard", "wandb", "ray", "viser",
):
    sys.modules[name] = None  # as if it were not installed

import pytest
import FOLDERS
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.envs import suite_env
from torchrl_gn.evaluation import evaluate_errors, plot_errors, rollout_frames
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import Budget, Trainer, load_pretrained, make_optimizer, save_checkpoint

scene = load_scene(MJCF)
trajectories = collect_trajectories(scene, 4, seed=0)
bound = ForwardModel.for_scene(scene, node_hidden=(8,), edge_hidden=(8,), global_hidden=(8,)).bind(scene)
loss = ForwardModelLoss(bound)
buffer = trajectory_buffer(trajectories, batch_size=8, seed=0)
loss.fit_normalizers(buffer.sample())
assert list(Trainer(loss, buffer, make_optimizer(bound.model.core), Budget(steps=2)).run())
save_checkpoint(FILE, bound.model, scene=scene)
quick = specialize(load_pretrained(FILE).model.bind(scene))
table = evaluate_errors(quick, trajectories, horizons=(2,))
with pytest.raises(ImportError, match=r'pip install "torchrl_gn\\[figures\\]"'):
    plot_errors({"pole": table}, FILE)
with pytest.raises(ImportError, match=r'pip install "torchrl_gn\\[figures\\]"'):
    rollout_frames(scene, trajectories["state"][0])
with pytest.raises(ImportError, match=r'pip install "torchrl_gn\\[suite\\]"'):
    load_scene("pendulum")
with pytest.raises(ImportError, match=r'pip install "torchrl_gn\\[suite\\]"'):
    suite_env("pendulum", "swingup")
"""


@pytest.mark.slow
def test_core_works_without_the_extras(tmp_path):
    mjcf, file = zoo.mjcf("pole"), str(tmp_path / "model.safetensors")
    code = WITHOUT_EXTRAS.replace("MJCF", repr(mjcf)).replace("FILE", repr(file))
    done = run(code.replace("FOLDERS", ", ".join(f"torchrl_gn.{folder}" for folder in FOLDERS)))
    assert done.returncode == 0, done.stderr


def exported(part: str) -> list[str]:
    """Public names of a folder."""
    nodes = [node for node in tree(part).body if isinstance(node, ast.ImportFrom)]
    return [alias.asname or alias.name for node in nodes for alias in node.names]


def tree(module: str) -> ast.Module:
    path = PACKAGE / module.replace(".", "/")
    return ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text())


def described(module: str, name: str) -> bool:
    """Whether a class, function or module has a docstring where it is defined, or a string stands behind a constant."""
    body = tree(module).body
    for node, behind in zip(body, [*body[1:], ast.Pass()], strict=True):
        if isinstance(node, ast.ImportFrom) and name in [alias.asname or alias.name for alias in node.names]:
            if node.module == f"torchrl_gn.{module}":
                return bool(ast.get_docstring(tree(f"{module}.{name}")))
            return described((node.module or "").removeprefix("torchrl_gn."), name)
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name:
            if "overload" in [each.id for each in node.decorator_list if isinstance(each, ast.Name)]:
                continue  # the function comes after
            return bool(ast.get_docstring(node))
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return isinstance(behind, ast.Expr) and isinstance(behind.value, ast.Constant)
    raise LookupError(f"{module} has no {name}")


@pytest.mark.parametrize("part", FOLDERS)
def test_every_public_name_is_described(part):
    names = exported(part)
    assert names and not [name for name in names if not described(part, name)]


def test_package_itself_is_light():
    done = run(
        "import sys, torchrl_gn\n"
        "names = dir(torchrl_gn), torchrl_gn.__all__, torchrl_gn.__version__\n"
        "print([name for name in sys.modules if name == 'torch' or name.startswith('torchrl_gn.')])"
    )
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_the_front_door_has_these_names_alone():
    assert torchrl_gn.__all__ == NAMES
    assert dir(torchrl_gn) == sorted([*NAMES, "__version__"])
    assert not hasattr(torchrl_gn, "no_such_name")
    # Type checkers read the same names from imports of their own.
    body = ast.parse((PACKAGE / "__init__.py").read_text()).body
    (block,) = [node for node in body if isinstance(node, ast.If) and is_for_types(node)]
    typed = [
        (node.module, [alias.name for alias in node.names]) for node in block.body if isinstance(node, ast.ImportFrom)
    ]
    assert sorted(typed) == sorted(
        (f"torchrl_gn.{folder}", [name]) for folder, names in PUBLIC.items() for name in names
    )


@pytest.mark.parametrize("name", NAMES)
def test_names_of_the_front_door_are_those_of_their_folders(name, monkeypatch):
    monkeypatch.delitem(vars(torchrl_gn), name, raising=False)  # as before its first use
    (folder,) = [folder for folder, names in PUBLIC.items() if name in names]
    assert getattr(torchrl_gn, name) is getattr(importlib.import_module(f"torchrl_gn.{folder}"), name)
    assert name in vars(torchrl_gn)


def test_warnings_of_the_package_fail_tests(pytestconfig):
    assert "error:::torchrl_gn" in pytestconfig.getini("filterwarnings")


def test_package_is_typed():
    assert (PACKAGE / "py.typed").exists()


def test_what_tests_import_late_exists():
    """A name that a function of a test imports is looked up only when the test runs, which may be a slow one."""
    files = [*Path(__file__).parent.rglob("*.py")]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    named = {
        (node.module or "", alias.name) for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    ours = {(module, name) for module, name in named if module.split(".")[0] == "torchrl_gn"}
    assert len(ours) > 100
    missing = [
        f"{module}.{name}"
        for module, name in sorted(ours)
        if f"{module}.{name}" not in MODULES and not hasattr(importlib.import_module(module), name)
    ]
    assert not missing


# Words that the field does not use, and the field's own (docs/glossary.md).
RETIRED = {
    r"linking|mechanism": "constraint projection, joint anchors",
    r"pins?|pinned|pin[_ ]finder": "joint anchor, anchor estimation",
    r"levers?|parent_arm": "anchor offset",
    r"headings?": "yaw, yaw frame",
    r"live (channels?|components?)": "movable components",
    r"SceneValues|static_key|static values": "physical parameters",
    r"JointChain|carried_by": "kinematic tree, parent",
    r"constant prediction": "persistence baseline",
    r"rivals?|contestants?": "baseline",
    r"foreseen|FixTask": "planned, freeze goal",
}


@pytest.mark.slow
def test_retired_words_come_back_nowhere():
    root = PACKAGE.parent
    places = (
        "torchrl_gn/**/*.py",
        "recipes/**/*.py",
        "recipes/**/*.yaml",
        "tests/**/*.py",
        "docs/**/*.md",
        "README.md",
    )
    files = [file for place in places for file in root.glob(place) if file != Path(__file__)]
    found = [
        f"{file.relative_to(root)}: {match[0]!r}, use {better}"
        for file in files
        for pattern, better in RETIRED.items()
        for match in re.finditer(rf"\b({pattern})\b", file.read_text(), re.IGNORECASE)
    ]
    assert not found, "\n".join(found)
