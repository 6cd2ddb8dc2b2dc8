"""Phase-function plugins for water and particles."""
