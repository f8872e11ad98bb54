"""Recipes' own modules, as Python finds them for a script in recipes."""

from __future__ import annotations

import sys

from ..copies import RECIPES

sys.path.append(str(RECIPES))
