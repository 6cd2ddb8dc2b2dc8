"""Figures and animations of gate stacks."""
