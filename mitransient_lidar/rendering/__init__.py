"""Rendering in independent passes until a result is accurate enough."""
