"""Figures and animations for gate stacks."""
