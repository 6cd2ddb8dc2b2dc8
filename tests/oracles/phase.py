"""Henyey-Greenstein phase functions in NumPy."""

import numpy as np


def henyey_greenstein(theta, g):
    """Return the Henyey-Greenstein (1941) function [1/sr] at angles [rad] for a mean cosine -1 < `g` < 1."""
    # 1 + g^2 - 2 g cos(theta), without its cancellation at small angles
    spread = (1 - g) ** 2 + 4 * g * np.sin(np.asarray(theta, dtype=np.float64) / 2) ** 2
    return (1 - g * g) / (4 * np.pi * spread**1.5)


def two_term_henyey_greenstein(theta, weight, g_forward, g_backward):
    """Return the mixture weight HG(g_forward) + (1 - weight) HG(-g_backward) [1/sr]."""
    return weight * henyey_greenstein(theta, g_forward) + (1 - weight) * henyey_greenstein(theta, -g_backward)
