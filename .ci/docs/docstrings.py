"""Docstrings as Markdown: roles become links into the reference where they lead there, formulas MathML."""

from __future__ import annotations

import re
import textwrap
from typing import Any

import griffe
from latex2mathml.converter import convert

ROLE = re.compile(r":(\w+):`([^`]+)`")
FORMULA = re.compile(r"^( *)\.\. math::(?: (.+)\n|\n((?:\1 +.*\n|\n)+))", re.MULTILINE)
COMMENT = re.compile(r"  # (?!noqa|pyright|type:)(.+)$")
EXAMPLE = re.compile(r"^( *)Example:$", re.MULTILINE)


class Markdown(griffe.Extension):
    """Rewrites all docstrings of a package once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Rewrite them."""
        public: dict[str, str] = {}  # names, where they are exported and defined: where the reference shows them
        for part in pkg.modules.values():
            if not part.is_package:
                continue
            inside = {name: at for name, at in part.imports.items() if at.startswith(f"{pkg.path}.")}
            for name, target in inside.items():
                shown = target if name in part.modules else f"{part.path}.{name}"
                public |= {name: shown, f"{part.path}.{name}": shown, target: shown}
        defined = {shown: target for target, shown in public.items() if "." in target}
        self._rewrite(pkg, pkg, public, defined)

    def _rewrite(self, pkg: griffe.Module, object_: griffe.Object, public: dict, defined: dict) -> None:
        if object_.docstring:
            owner = object_ if object_.is_class else object_.parent
            object_.docstring.value = self._markdown(object_.docstring.value, pkg, owner, public, defined)
        if object_.is_class and "dataclass" in object_.labels:
            self._describe(object_)
        for member in object_.members.values():
            if not isinstance(member, griffe.Alias):
                self._rewrite(pkg, member, public, defined)

    @staticmethod
    def _describe(class_: griffe.Object) -> None:
        """Describe the fields of a dataclass by the comments behind them."""
        for field in class_.attributes.values():
            if not field.docstring and (comment := COMMENT.search(field.source)):
                first, _, rest = comment[1].partition(" ")
                first = first.capitalize() if first.isalpha() and first.islower() else first  # no units, no names
                field.docstring = griffe.Docstring(f"{first} {rest}", parent=field)

    def _markdown(self, text: str, pkg: griffe.Module, owner: Any, public: dict, defined: dict) -> str:
        def formula(match: re.Match[str]) -> str:
            latex = textwrap.dedent(match[2] or match[3]).strip()
            if r"\\" in latex:  # several lines
                latex = rf"\begin{{align}}{latex}\end{{align}}"
            return f"{match[1]}<div>{convert(latex, display='block')}</div>\n\n"

        def role(match: re.Match[str]) -> str:
            kind, content = match.groups()
            if kind == "math":
                return convert(content)
            shown, target = content, content
            if explicit := re.fullmatch(r"(.+?) <(.+)>", content):
                shown, target = explicit.groups()
            elif content.startswith("~"):
                target = content[1:]
                shown = target.rpartition(".")[2]
            found = self._find(target, pkg, owner, public, defined)
            return f"[`{shown}`][{found}]" if found else f"`{shown}`"

        return ROLE.sub(role, FORMULA.sub(formula, EXAMPLE.sub(r"\1Examples:", text)))

    def _find(self, target: str, pkg: griffe.Module, owner: Any, public: dict, defined: dict) -> str | None:
        """Where the reference shows what a role names, or None."""
        if owner is not None and owner.is_class and "." not in target and target in owner.members:
            target = f"{owner.path}.{target}"
        if target in public:
            return public[target]
        parent, _, name = target.rpartition(".")
        if parent not in public:
            return None
        path = defined[public[parent]].removeprefix(f"{pkg.path}.")
        member = pkg[path].members.get(name)
        return f"{public[parent]}.{name}" if member is not None and member.docstring else None
