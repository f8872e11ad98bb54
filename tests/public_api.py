"""Table of all public names and signatures: ``python -m tests.public_api`` writes it to tests/public_api.txt.

A part's public names are those that its ``__init__.py`` imports. Of a class, the table has the constructor, and the
methods, properties and annotated attributes without an underscore that the class or its bases in the package define. It
leaves out what comes from PyTorch, TorchRL or Python, and so does not depend on their versions.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import importlib
import inspect
import re
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import torchrl_gn

PACKAGE = Path(torchrl_gn.__file__).parent
TABLE = Path(__file__).with_suffix(".txt")
WIDTH = 120
HEADER = "# Public names and signatures, made by `python -m tests.public_api`.\n"
PROPERTIES = (property, functools.cached_property)


def table() -> str:
    """The whole table: the names of ``import torchrl_gn``, then every part."""
    front = (f"torchrl_gn.{name} = {home(getattr(torchrl_gn, name))}" for name in torchrl_gn.__all__)
    blocks = ["\n".join(front)]
    for part in sorted(file.parent.name for file in PACKAGE.glob("*/__init__.py")):
        module = importlib.import_module(f"torchrl_gn.{part}")
        names = sorted(name for name in vars(module) if is_exported(module, name))
        blocks += ["\n".join(line for name in names for line in lines(f"{part}.{name}", getattr(module, name)))]
    return HEADER + "\n" + "\n\n".join(blocks) + "\n"


def home(value: Any) -> str:
    """The part and name of a front door's name."""
    return f"{value.__module__.split('.')[1]}.{value.__name__}"


def is_exported(package: ModuleType, name: str) -> bool:
    """True for names that ``__init__.py`` imports: ``from X import NAME as NAME``."""
    source = Path(str(package.__file__)).read_text()
    return (
        not name.startswith("_") and re.search(rf"^from torchrl_gn\S* import \w+ as {name}$", source, re.M) is not None
    )


def lines(path: str, value: Any) -> Iterator[str]:
    """Lines of a name: itself, and its members if it is a class or a module."""
    if inspect.isclass(value):
        yield from class_lines(path, value)
    elif inspect.ismodule(value):
        yield path
        for name, member in sorted(vars(value).items()):
            if inspect.isfunction(member) and member.__module__ == value.__name__ and not name.startswith("_"):
                yield from call_lines(f"{path}.{name}", member)
    elif inspect.isroutine(value):
        yield from call_lines(path, value)
    elif typing.get_origin(value) is typing.Literal:
        yield f"{path} = Literal[{', '.join(map(repr, typing.get_args(value)))}]"
    else:
        yield path


def class_lines(path: str, cls: type) -> Iterator[str]:
    """Lines of a class: its constructor, then its public members by name."""
    ours = [base for base in cls.__mro__ if base.__module__.split(".")[0] == cls.__module__.split(".")[0]]
    makers = [base for base in cls.__mro__ if {"__init__", "__new__"} & vars(base).keys()]
    if issubclass(cls, enum.Enum):
        yield path
        yield from (f"{path}.{name}" for name in sorted(cls.__members__))
    elif makers[0] in ours and not getattr(cls, "_is_protocol", False):
        maker = vars(makers[0]).get("__init__") or makers[0].__new__  # a metaclass may hide what the class itself takes
        yield from call_lines(path, maker, returns=False, drop_self=True)
    else:
        yield path
    fields = {field.name for field in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else set()
    fields |= {*getattr(cls, "_fields", ()), *getattr(cls, "__members__", ())}  # of named tuples and enumerations
    members: dict[str, Any] = {}
    types: dict[str, Any] = {}
    for base in reversed(ours):
        members |= vars(base)
        types |= vars(base).get("__annotations__", {})
    found = {name: member for name, member in members.items() if is_public(name)}
    for name in sorted({*found, *filter(is_public, types)} - fields):
        member, place = found.get(name), f"{path}.{name}"
        if isinstance(member, PROPERTIES):
            getter = member.fget if isinstance(member, property) else member.func
            yield f"{place}{typed(getattr(getter, '__annotations__', {}).get('return', inspect.Parameter.empty))}"
        elif isinstance(member, (staticmethod, classmethod)) or inspect.isfunction(member):
            bound = isinstance(member, (staticmethod, classmethod))
            if name == "__call__" and str(inspect.signature(member)).startswith("(self, *args"):
                continue  # forward says more
            yield from call_lines(place, getattr(cls, name) if bound else member, drop_self=not bound)
        else:
            yield f"{place}{typed(types.get(name, inspect.Parameter.empty))}"


def is_public(name: str) -> bool:
    return name in ("__call__", "__getitem__", "__len__") or not name.startswith("_") and name != "extra_repr"


def call_lines(path: str, call: Any, *, returns: bool = True, drop_self: bool = False) -> Iterator[str]:
    """A signature on one line, or an argument on each if that is too long."""
    signature = inspect.signature(call)
    arguments = list(written(list(signature.parameters.values())[1 if drop_self else 0 :]))
    result = signature.return_annotation if returns else inspect.Signature.empty
    end = f") -> {name_of(result)}" if result is not inspect.Signature.empty else ")"
    if len(line := f"{path}({', '.join(arguments)}{end}") <= WIDTH:
        yield line
    else:
        yield f"{path}("
        yield from (f"    {argument}," for argument in arguments)
        yield end


def written(parameters: Iterable[inspect.Parameter]) -> Iterator[str]:
    """Arguments as in a definition, with ``/`` and ``*``."""
    kind, only_position, star = inspect.Parameter, False, False
    for each in parameters:
        if only_position and each.kind is not kind.POSITIONAL_ONLY:
            yield "/"
        only_position = each.kind is kind.POSITIONAL_ONLY
        if each.kind is kind.KEYWORD_ONLY and not star:
            yield "*"
        star = star or each.kind in (kind.KEYWORD_ONLY, kind.VAR_POSITIONAL)
        stars = {kind.VAR_POSITIONAL: "*", kind.VAR_KEYWORD: "**"}.get(each.kind, "")
        text = f"{stars}{each.name}{typed(each.annotation)}"
        if each.default is not kind.empty:
            text += f"{' = ' if ': ' in text else '='}{default_of(each.default)}"
        yield text
    if only_position:
        yield "/"


def typed(annotation: Any) -> str:
    return "" if annotation is inspect.Parameter.empty else f": {name_of(annotation)}"


def name_of(annotation: Any) -> str:
    """An annotation as the source has it."""
    if isinstance(annotation, str):
        return annotation
    return getattr(annotation, "__forward_arg__", None) or inspect.formatannotation(annotation)


def default_of(value: Any) -> str:
    """Return a default value as text, without parts that differ between processes or versions of Python."""
    if isinstance(value, enum.Enum):
        return f"{type(value).__name__}.{value.name}"
    if inspect.isclass(value) or inspect.isroutine(value):
        return value.__qualname__
    return re.sub(r"<class '[\w.]*?(\w+)'>", r"\1", repr(value))


if __name__ == "__main__":
    TABLE.write_text(table())
    print(f"wrote {TABLE}")
