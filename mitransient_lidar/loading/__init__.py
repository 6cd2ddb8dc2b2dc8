"""Scenes by name or path, their parameters, and Mitsuba variants."""
