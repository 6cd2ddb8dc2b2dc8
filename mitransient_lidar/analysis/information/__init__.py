"""Information of waveforms about parameters: fits."""
