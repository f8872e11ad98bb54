# MuJoCo's compiled module has no type hints: every name in it is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
