"""Hooks of the documentation site: pages of the reference, and links to files that are no pages.

What the reference lacks is a warning, which fails a strict build.

A link from ``docs`` to another file of the repository works on a code host. In the site it leads to the code host if
``repo_url`` names one, and is the file's name otherwise.
"""

from __future__ import annotations

import ast
import logging
import posixpath
import re
from pathlib import Path

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
    "policies": "policies.md",
    "rewards": "envs.md#rewards",
    "objectives": "objectives.md",
    "drawing": "evaluation.md",
    "envs": "envs.md",
    "planners": "planning.md",
    "evaluation": "evaluation.md",
    "training": "training.md",
}
"""Public parts of the package, and the page that explains each."""

LOG = logging.getLogger("mkdocs.hooks.pages")
LINK = re.compile(r"\[([^\]]+)\]\((\.\./[^)#\s]+)(#[^)\s]*)?\)")


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


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page of the reference for every part."""
    for part, page in PARTS.items():
        names = [name for name in exported(part) if not hidden(part, name)]
        text = f"# torchrl_gn.{part}\n\n[What it is and how to use it](../{page}).\n\n"
        text += f"::: torchrl_gn.{part}\n    options: {{members: {names}}}\n"
        for name in exported(part):
            if path := hidden(part, name):
                text += f"\n::: torchrl_gn.{part}.{path}\n"
                text += (
                    "    options: {show_root_heading: true, show_root_toc_entry: true, show_root_full_path: false}\n"
                )
        files.append(File.generated(config, f"reference/{part}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links out of ``docs`` into links to the code host, or names of files."""
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
    """Look whether a page of the reference shows every public name, and no markup that is not Markdown."""
    folder, _, part = page.file.src_uri.removesuffix(".md").rpartition("/")
    if folder == "reference":
        for name in exported(part):
            if f'id="torchrl_gn.{part}.{hidden(part, name) or name}"' not in html:
                LOG.warning(f"{page.file.src_uri} does not show torchrl_gn.{part}.{name}.")
        for role in re.findall(r":(?:func|class|meth|attr|data|mod|math):|\.\. \w+::", html):
            LOG.warning(f"{page.file.src_uri} shows {role!r}.")
    return html
