"""Paths of light, from the laser and from the receiver."""
