"""Flights: trajectories of platforms, scanners and their mounting."""
