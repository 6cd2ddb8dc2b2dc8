"""Plugins for plants on a bottom."""
