"""Poses of pulses: trajectories of platforms, scanners and their mounting."""
