"""Public names and signatures match tests/public_api.txt."""

from __future__ import annotations

import difflib
import enum
from dataclasses import dataclass, field

import torch

from . import public_api


def test_public_names_and_signatures_are_those_of_the_table():
    found = public_api.table()
    stored = public_api.TABLE.read_text()
    difference = difflib.unified_diff(stored.splitlines(), found.splitlines(), "public_api.txt", "code", "", "", 1, "")
    assert found == stored, "\n".join(
        ["Public names or signatures differ. If that is meant, run python -m tests.public_api:", *difference]
    )


class Kind(enum.Enum):
    SLIDE = 1
    HINGE = 2


class Meta(type):
    def __call__(cls, *args, **kwargs):
        return super().__call__(*args, **kwargs)


class Base(metaclass=Meta):
    gravity: float

    def __init__(self, size: int, /, *names: str, kind: Kind = Kind.HINGE, act=torch.nn.SiLU, **more: int) -> None: ...

    def step(self, state: torch.Tensor) -> torch.Tensor: ...


class Body(Base):
    @property
    def mass(self) -> float: ...

    @classmethod
    def of(cls, size, *, scale=float("inf")) -> Body: ...

    @staticmethod
    def zero() -> int: ...

    def _hidden(self): ...


@dataclass
class Options:
    steps: int
    names: list[str] = field(default_factory=list)


class Failure(ValueError):
    pass


def test_lines_of_a_class_are_its_constructor_and_members():
    assert list(public_api.lines("p.Body", Body)) == [
        "p.Body(size: int, /, *names: str, kind: Kind = Kind.HINGE, act=SiLU, **more: int)",
        "p.Body.gravity: float",
        "p.Body.mass: float",
        "p.Body.of(size, *, scale=inf) -> Body",
        "p.Body.step(state: torch.Tensor) -> torch.Tensor",
        "p.Body.zero() -> int",
    ]


def test_lines_of_data_enumerations_and_errors():
    assert list(public_api.lines("p.Options", Options)) == ["p.Options(steps: int, names: list[str] = <factory>)"]
    assert list(public_api.lines("p.Kind", Kind)) == ["p.Kind", "p.Kind.HINGE", "p.Kind.SLIDE"]
    assert list(public_api.lines("p.Failure", Failure)) == ["p.Failure"]
    assert list(public_api.lines("p.LIMIT", 3)) == ["p.LIMIT"]


def test_a_long_signature_has_an_argument_a_line():
    def wide(first: int, /, *, second: str = "a" * 120) -> None: ...

    assert list(public_api.lines("p.wide", wide)) == [
        "p.wide(",
        "    first: int,",
        "    /,",
        "    *,",
        f"    second: str = '{'a' * 120}',",
        ") -> None",
    ]
