"""Benchmarks: integrator speed and accuracy, narrow beams, and images."""
