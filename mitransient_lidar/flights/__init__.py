"""Flights: pulses along a trajectory, echo positions, and files with points and waveforms."""
