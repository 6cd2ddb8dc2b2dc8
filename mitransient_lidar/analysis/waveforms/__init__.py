"""Echoes and columns measured in waveforms."""
