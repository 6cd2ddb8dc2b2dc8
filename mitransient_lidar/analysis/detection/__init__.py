"""Target detection in noise and clutter."""
