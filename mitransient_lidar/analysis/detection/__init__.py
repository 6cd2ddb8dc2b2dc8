"""Detection of a target in noise and clutter."""
