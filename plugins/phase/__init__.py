"""Phase functions of water and of what floats in it."""
