"""Known answers that only tests use."""
