"""Benchmarks: speed and accuracy of the integrators, of narrow beams, and of images."""
