"""Rules of the whole package: what it imports, in which direction, and that it keeps silent."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

import torchrl_gn

PACKAGE = Path(torchrl_gn.__file__).parent

# A folder imports from itself and from those before it: the data flow is the reading order.
ALLOWED = {
    "scenes": set(),
    "data": {"scenes"},
    "modules": {"scenes"},
    "rewards": {"scenes", "modules"},
    "objectives": {"scenes", "data", "modules", "rewards"},
    "envs": {"scenes", "data", "modules", "rewards"},
    "planners": {"scenes", "data", "modules", "rewards", "objectives", "envs"},
    "evaluation": {"scenes", "data", "modules", "rewards", "objectives", "envs", "planners"},
    "training": {"scenes", "data", "modules", "rewards", "objectives", "envs", "planners", "evaluation"},
}
ANYWHERE = {"atomic", "finite", "processor"}  # modules beside the folders


def imports(tree: ast.AST) -> list[str]:
    """Absolute names of all modules that a file imports, inside functions too."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names.append(node.module or "")
    return names


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda file: str(file.relative_to(PACKAGE)))
def test_imports_point_one_way(file):
    folder = file.relative_to(PACKAGE).parts[0]
    if folder not in ALLOWED:
        return
    inside = [name.split(".") for name in imports(ast.parse(file.read_text())) if name.startswith("torchrl_gn")]
    parts = {name[1] for name in inside if len(name) > 1}
    wrong = parts - ALLOWED[folder] - ANYWHERE - {folder}
    assert not wrong, f"torchrl_gn.{folder} must not import torchrl_gn.{', '.join(sorted(wrong))}"


def test_what_is_imported_is_declared():
    """What only a dependency of a dependency brings would one day fail a plain install."""
    lines = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    needed, optional = (
        {re.split(r"[<>=\[]", line)[0] for line in some}
        for some in (lines["dependencies"], itertools.chain(*lines["optional-dependencies"].values()))
    )
    brought_by = metadata.packages_distributions()
    for file in PACKAGE.rglob("*.py"):
        parsed = ast.parse(file.read_text())
        inside = [node for node in ast.walk(parsed) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
        later = {name for function in inside for name in imports(function)}
        for name in imports(parsed):
            package = name.split(".")[0]
            if package in sys.stdlib_module_names | {"torchrl_gn"}:
                continue
            known = needed | optional if name in later else needed
            distributions = {found.replace("_", "-") for found in brought_by[package]}
            assert distributions & known, f"{file.name} imports {name}, which pyproject.toml does not name"


def test_every_folder_has_a_place_in_the_order():
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert folders <= set(ALLOWED)


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda file: str(file.relative_to(PACKAGE)))
def test_library_does_not_print(file):
    if file.name == "__main__.py":  # the command line
        return
    for node in ast.walk(ast.parse(file.read_text())):
        assert not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print")


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_importing_everything_is_silent_and_leaves_the_recipes_libraries_alone():
    folders = [f"torchrl_gn.{folder}" for folder in ALLOWED if (PACKAGE / folder / "__init__.py").exists()]
    done = run(
        f"import sys, {', '.join(['torchrl_gn', *folders])}\n"
        "wanted = {'hydra', 'omegaconf', 'wandb', 'dm_control', 'gymnasium', 'matplotlib.pyplot'}\n"
        "print(sorted(wanted & set(sys.modules)))"
    )
    assert done.returncode == 0, done.stderr
    assert (done.stdout, done.stderr) == ("[]\n", "")


def exported(part: str) -> list[str]:
    """Public names of a folder, or of the module ``pretrained``."""
    if part == "pretrained":
        return [node.name for node in tree(part).body if isinstance(node, ast.FunctionDef)]
    imported = [node for node in tree(part).body if isinstance(node, ast.ImportFrom)]
    return [alias.asname or alias.name for node in imported for alias in node.names]


def tree(module: str) -> ast.Module:
    path = PACKAGE / module.replace(".", "/")
    return ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text())


def described(module: str, name: str) -> bool:
    """Whether a class or function has a docstring where it is defined, or a string stands behind a constant."""
    body = tree(module).body
    for node, behind in zip(body, [*body[1:], ast.Pass()], strict=True):
        if isinstance(node, ast.ImportFrom) and name in [alias.asname or alias.name for alias in node.names]:
            return described((node.module or "").removeprefix("torchrl_gn."), name)
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name:
            return bool(ast.get_docstring(node))
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return isinstance(behind, ast.Expr) and isinstance(behind.value, ast.Constant)
    raise LookupError(f"{module} has no {name}")


@pytest.mark.parametrize("part", [*ALLOWED, "pretrained"])
def test_every_public_name_is_described(part):
    names = exported(part)
    assert names and not [name for name in names if not described(part, name)]


def test_package_itself_is_light():
    done = run("import sys, torchrl_gn; print(torchrl_gn.__version__, 'torch' in sys.modules)")
    assert (done.stdout, done.stderr) == (f"{torchrl_gn.__version__} False\n", "")


def test_warnings_of_the_package_fail_tests(pytestconfig):
    assert "error:::torchrl_gn" in pytestconfig.getini("filterwarnings")


def test_package_is_typed():
    assert (PACKAGE / "py.typed").exists()
