"""Pulse poses: platform trajectories, scanners and their mounting."""
