"""Phase-function plugins of water and particles."""
