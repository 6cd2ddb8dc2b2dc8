"""Formulas and tables in NumPy.

Arguments outside the ranges in their descriptions raise `core.errors.UserError`; sections Raises list other causes.
"""
