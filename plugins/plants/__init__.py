"""Plugins of plants on a bottom."""
