"""Shipped scenes, and the shared parts that they include, as Mitsuba XML files."""
