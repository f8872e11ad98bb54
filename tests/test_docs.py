"""Every Python example and every link of the README and the docs works."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHORTENED = {"README.md": {"minutes=1": "steps=3", "1000": "20", "50": "5"}}
"""Parts of long examples, and the test's shorter replacements."""
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def examples(page: Path) -> list[str]:
    """Python blocks of a page, each behind as many empty lines as stand above it."""
    text = page.read_text()
    blocks = [match for match in FENCE.finditer(text) if match[1] == "python"]
    return ["\n" * text.count("\n", 0, match.start(2)) + shortened(page, match[2]) for match in blocks]


def shortened(page: Path, block: str) -> str:
    for long, short in SHORTENED.get(name(page), {}).items():
        assert long in block, f"{name(page)} does not say {long}"
        block = block.replace(long, short)
    return block


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if examples(page)], ids=name)
def test_examples_run(page, tmp_path, monkeypatch):
    """The blocks of one page share their names and run from top to bottom in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "recipes")  # as for a recipe
    names = {"__name__": "__example__"}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # what a reader would see on the screen
        warnings.filterwarnings("ignore", "(?s).*get_attr")  # torch 2.7, as it loads a program
        for block in examples(page):
            exec(compile(block, name(page), "exec", dont_inherit=True), names)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    text = FENCE.sub("", page.read_text())
    for link in re.findall(r"\]\(([^)]+)\)", text):
        if "://" in link or link.startswith("mailto:"):
            assert re.fullmatch(r"https?://[\w-]+(\.[\w-]+)+(/\S*)?|mailto:\S+@\S+", link), (
                f"{name(page)} links to {link}"
            )
            continue
        target, _, anchor = link.partition("#")
        file = page.parent / target if target else page
        assert file.exists(), f"{name(page)} links to {link}"
        if anchor:
            titles = re.findall(r"^#+ (.+)$", FENCE.sub("", file.read_text()), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
            assert anchor in anchors, f"{name(page)} links to {link}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_named_files_exist(page):
    """Recipes and folders of this repository that a page names in code are there."""
    for path in re.findall(r"(?:recipes|torchrl_gn|tests|docs)/[\w/.-]*\w", page.read_text()):
        assert (ROOT / path).exists(), f"{name(page)} names {path}"


def test_readme_has_two_setup_commands_and_ci_runs_its_test_command():
    commands = [line for line in (ROOT / "README.md").read_text().splitlines() if "-m venv" in line]
    assert len(commands) == 2
    assert "recipes/forward_model.py" in commands[0] and commands[1].endswith('-m "not slow"')
    ci = (ROOT / ".ci" / "run").read_text()
    assert "README.md" in ci and "-m slow" in ci  # together all of the tests


def test_every_page_is_in_the_menu_of_the_site():
    menu = (ROOT / "mkdocs.yml").read_text()
    pages = [str(page.relative_to(ROOT / "docs")) for page in PAGES if ROOT / "docs" in page.parents]
    parts = [folder.parent.name for folder in (ROOT / "torchrl_gn").glob("*/__init__.py")]
    for page in [*pages, *(f"reference/{part}.md" for part in parts)]:
        assert f": {page}\n" in menu, f"mkdocs.yml does not lead to {page}"
