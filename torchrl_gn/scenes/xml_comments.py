"""Comments in the XML of models."""

from __future__ import annotations

import re

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


def without_comments(text: str) -> str:
    """Return a model's text without comments, also those that XML forbids, with "--" inside; MuJoCo reads them."""
    return _COMMENT.sub("", text)
