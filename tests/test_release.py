"""One version number, and files of the release and CI that agree with pyproject.toml."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import pytest
import yaml

import torchrl_gn

ROOT = Path(__file__).parents[1]
VERSION = torchrl_gn.__version__
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def text(file: str) -> str:
    return (ROOT / file).read_text()


def test_version_stands_in_the_package_alone():
    project = text("pyproject.toml")
    assert re.search(r'^dynamic = \["version"\]', project, re.MULTILINE)
    assert not re.search(r"^version\b", project, re.MULTILINE)
    assert '[tool.hatch.version]\npath = "torchrl_gn/__init__.py"\n' in project
    assert re.findall(r'^__version__ = "(.+)"$', text("torchrl_gn/__init__.py"), re.MULTILINE) == [VERSION]
    assert re.fullmatch(r"\d+\.\d+\.\d+((a|b|rc)\d+)?", VERSION)  # a tag is v and this


def test_installed_package_has_the_version():
    assert metadata.version("torchrl_gn") == VERSION, "The version has changed: install the package again."


def test_citations_name_the_version():
    assert re.findall(r"^  version = \{(.+)\},$", text("README.md"), re.MULTILINE) == [VERSION]
    assert yaml.safe_load(text("CITATION.cff"))["version"] == VERSION


def test_changelog_has_each_kind_of_change_once_a_version():
    _, *versions = re.split(r"^## ", text("CHANGELOG.md"), flags=re.MULTILINE)
    assert versions[0].startswith("[Unreleased]\n")
    for version in versions:
        kinds = re.findall(r"^### (.+)$", version, re.MULTILINE)
        assert len(kinds) == len(set(kinds)), f"{version.splitlines()[0]} has a kind of change twice: {kinds}"
        assert set(kinds) <= {"Security", "Changed", "Added", "Deprecated", "Fixed", "Removed"}


@pytest.mark.parametrize("file", WORKFLOWS, ids=lambda file: file.name)
def test_workflows_have_least_permissions_and_versions_of_actions(file):
    workflow = yaml.safe_load(file.read_text())
    assert workflow["permissions"] == {"contents": "read"}
    allowed = {"deploy": {"pages", "id-token"}, "publish": {"id-token"}}
    for name, job in workflow["jobs"].items():
        assert set(job.get("permissions", ())) == allowed.get(name, set())
        for step in job["steps"]:
            assert re.fullmatch(r"[\w/-]+@(v\d+|release/v1)", step.get("uses", "a@v1"))
            if step.get("uses", "").startswith("actions/checkout@"):
                assert step["with"] == {"persist-credentials": False}


def test_ci_runs_everything_and_the_ends_of_the_ranges():
    jobs = yaml.safe_load(text(".github/workflows/ci.yml"))["jobs"]
    assert jobs["all"]["steps"][-1] == {"run": ".ci/run"}
    rows = {tuple(row.values()) for row in jobs["tests"]["strategy"]["matrix"]["include"]}
    newest = max(re.findall(r"Python :: 3\.(\d+)", text("pyproject.toml")), key=int)
    assert {
        ("oldest", "3.11", "ubuntu-latest"),
        ("newest", "3.11", "ubuntu-latest"),
        ("newest", f"3.{newest}", "ubuntu-latest"),
        ("constrained", "3.11", "ubuntu-24.04-arm"),
    } == rows


def test_oldest_versions_are_the_lower_bounds():
    dependencies = text("pyproject.toml").split("dependencies = [")[1].split("]")[0]
    bounds = dict(re.findall(r'"([\w-]+)>=([\d.]+)', dependencies))
    oldest = dict(re.findall(r"^([\w-]+)==([\d.]+)$", text(".ci/oldest.txt"), re.MULTILINE))
    for name, bound in bounds.items():
        if name != "torch":
            assert oldest[name].removesuffix(".0") == bound.removesuffix(".0"), name
    assert re.search(r'^ *"torch>=[0-9.]+",$', text("pyproject.toml"), re.MULTILINE)  # as .ci/versions reads it


def test_pre_commit_has_the_ruff_of_ci():
    (ruff,) = re.findall(r"^ruff==(.+)$", text("constraints.txt"), re.MULTILINE)
    hooks = {each["repo"]: each["rev"] for each in yaml.safe_load(text(".pre-commit-config.yaml"))["repos"]}
    assert hooks["https://github.com/astral-sh/ruff-pre-commit"] == f"v{ruff}"
