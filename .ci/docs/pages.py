"""Hooks of the documentation site: reference, code of the examples, version, and links to files that are no pages.

The reference has a page for every public name, and for every part a page that lists them. What it lacks is a warning,
which fails a strict build.

A link from ``docs`` to another file of the repository works on a code host. In the site it leads to the code host if
``repo_url`` names one, and is the file's name otherwise.
"""

from __future__ import annotations

import ast
import logging
import posixpath
import re
from pathlib import Path

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PACKAGE = Path(__file__).parents[2] / "torchrl_gn"

PARTS = {
    "scenes": "scenes.md",
    "data": "data.md",
    "maths": "maths.md",
    "networks": "networks.md",
    "dynamics": "dynamics.md",
    "identification": "identification.md",
    "rewards": "envs.md#rewards",
    "policies": "policies.md",
    "objectives": "objectives.md",
    "drawing": "evaluation.md",
    "envs": "envs.md",
    "planners": "planning.md",
    "evaluation": "evaluation.md",
    "training": "training.md",
    "actor_critic": "policies.md#an-actor-critic-of-your-own",
    "viewer": "viewer.md",
}
"""Public parts of the package, and the page that explains each."""

LOG = logging.getLogger("mkdocs.hooks.pages")
LINK = re.compile(r"\[([^\]]+)\]\((\.\./[^)#\s]+)(#[^)\s]*)?\)")
CODE = re.compile(r"^\[`(\w+\.py)`\]\(\1\)$", re.MULTILINE)
ROLE = re.compile(r":\w+:`(?:[^`<]+<)?~?(?:[\w.]*\.)?(\w+)>?`")
BOOST = {"glossary.md": 4, "guides": 2, "reference": 0.2}
"""Weights of pages in a search, by file or folder."""


def exported(part: str) -> list[str]:
    """Public names of a part: what its package imports."""
    body = ast.parse((PACKAGE / part / "__init__.py").read_text()).body
    imports = (node for node in body if isinstance(node, ast.ImportFrom) and node.module != "__future__")
    names = [alias.asname or alias.name for node in imports for alias in node.names]
    return sorted(name for name in names if not name.startswith("_"))


def hidden(part: str, name: str) -> str | None:
    """Path of a public name that a module of the same name hides from static analysis, or is; None of others."""
    file = PACKAGE / part / f"{name}.py"
    if not file.exists():
        return None
    defined = [
        node.name for node in ast.parse(file.read_text()).body if isinstance(node, (ast.ClassDef, ast.FunctionDef))
    ]
    return f"{name}.{name}" if name in defined else name


def summary(package: griffe.Object | griffe.Alias, part: str, name: str) -> str:
    """First line of a description, without markup."""
    docstring = package[f"{part}.{hidden(part, name) or name}"].docstring
    if docstring is None:
        LOG.warning(f"torchrl_gn.{part}.{name} has no description.")
        return ""
    line = docstring.value.split("\n\n")[0].replace("\n", " ").replace(":math:", "")
    return ROLE.sub(r"\1", line).replace("``", "`").replace("|", r"\|")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Show the package's version at the foot of every page."""
    (version,) = re.findall(r'^__version__ = "(.+)"$', (PACKAGE / "__init__.py").read_text(), re.MULTILINE)
    config.copyright = f"torchrl_gn {version}"
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the reference, and the site's own style and script."""
    package = griffe.load("torchrl_gn", search_paths=[PACKAGE.parent])
    for part, page in PARTS.items():
        rows = []
        for name in exported(part):
            path = hidden(part, name) or name
            text = f"---\ntitle: {name}\n---\n\n[torchrl_gn.{part}](../{part}.md)\n\n::: torchrl_gn.{part}.{path}\n"
            text += "    options: {show_root_heading: true, show_root_full_path: false, heading_level: 1}\n"
            files.append(File.generated(config, f"reference/{part}/{name}.md", content=text))
            rows.append(f"| [`{name}`]({part}/{name}.md) | {summary(package, part, name)} |\n")
        text = f"# torchrl_gn.{part}\n\n[What it is and how to use it](../{page}).\n\n| name | what |\n|---|---|\n"
        files.append(File.generated(config, f"reference/{part}.md", content=text + "".join(rows)))
    for file in sorted((Path(__file__).parent / "assets").iterdir()):
        files.append(File.generated(config, f"assets/{file.name}", abs_src_path=str(file)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Weigh the page in a search, show the code of examples, turn links out of ``docs`` into links to the code host."""
    for place, boost in BOOST.items():
        if page.file.src_uri.split("/")[0] == place:
            page.meta.setdefault("search", {"boost": boost})
    if page.file.src_uri == "examples/README.md":
        code = (PACKAGE.parent / "docs" / "examples").joinpath
        markdown = CODE.sub(lambda link: f"{link[0]}\n\n```python\n{code(link[1]).read_text()}```", markdown)
    folder = posixpath.join("docs", posixpath.dirname(page.file.src_uri))

    def replaced(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, match[2]))
        if path.startswith("docs/"):
            return match[0]
        if config.repo_url:
            return f"[{match[1]}]({config.repo_url.rstrip('/')}/blob/HEAD/{path}{match[3] or ''})"
        return match[1] if match[1].strip("`") == path else f"{match[1]} (`{path}`)"

    return LINK.sub(replaced, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Look whether a page of the reference shows its name, and no markup that is not Markdown."""
    parents = page.file.src_uri.removesuffix(".md").split("/")
    if parents[0] == "reference":
        if len(parents) == 3:
            path = f"torchrl_gn.{parents[1]}.{hidden(*parents[1:]) or parents[2]}"
            if f'id="{path}"' not in html:
                LOG.warning(f"{page.file.src_uri} does not show {path}.")
        for role in re.findall(r":(?:func|class|meth|attr|data|mod|math):|\.\. \w+::", html):
            LOG.warning(f"{page.file.src_uri} shows {role!r}.")
    return html
