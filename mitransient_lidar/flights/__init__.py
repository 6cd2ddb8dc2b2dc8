"""Flights: pulses along a trajectory, the places of their echoes, and files of points and waveforms."""
