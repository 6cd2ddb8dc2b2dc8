"""Flights: points and waveforms of a flight as LAS files."""
