"""Recipes' own modules, which Python finds once ``copies`` is imported."""

from ..copies import RECIPES as RECIPES
