"""Solids: which shapes light meets, apart where they touch."""
