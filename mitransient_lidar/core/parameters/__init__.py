"""Declarations: the parameters of all plugins."""
