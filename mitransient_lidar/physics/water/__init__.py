"""Inherent optical properties and phase functions of water."""
