"""Shipped scenes: Mitsuba XML files, made to be read, copied and edited."""
