"""Gates cut from waveforms, and range images from gates."""
