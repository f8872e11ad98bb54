"""Projection onto joint constraints."""
