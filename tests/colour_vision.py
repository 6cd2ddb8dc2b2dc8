"""Differences between colours as readers with normal and with deficient colour vision see them.

Simulation: G. M. Machado, M. M. Oliveira, L. A. F. Fernandes, "A physiologically-based model for simulation of color
vision deficiency", IEEE Trans. Vis. Comput. Graph. 15, 1291 (2009), severity 1. Differences: CIEDE2000, G. Sharma,
W. Wu, E. N. Dalal, Color Res. Appl. 30, 21 (2005).
"""

import itertools

import numpy as np
from matplotlib.colors import to_rgb

#: From linear sRGB to linear sRGB.
VISION = {
    "normal": np.eye(3),
    "protanopia": [(0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)],
    "deuteranopia": [(0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)],
    "tritanopia": [(1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)],
}

_TO_XYZ = np.array(
    [(0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.072175), (0.0193339, 0.119192, 0.9503041)]
)


def lab(colour, vision="normal"):
    """Return CIELAB coordinates (white: D65) of a colour of Matplotlib."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = _TO_XYZ @ np.clip(np.array(VISION[vision]) @ linear, 0, 1) / _TO_XYZ.sum(axis=1)
    x, y, z = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


def ciede2000(first, second):
    """Return the difference of two colours in CIELAB coordinates."""
    (l1, a1, b1), (l2, a2, b2) = first, second
    mean = 0.5 * (np.hypot(a1, b1) + np.hypot(a2, b2))
    stretch = 1.5 - 0.5 * np.sqrt(mean**7 / (mean**7 + 25.0**7))
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, stretch * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    turn = (h2 - h1 + 180) % 360 - 180 if c1 * c2 else 0.0
    hue_step = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn) / 2)
    light, chroma, hue = 0.5 * (l1 + l2), 0.5 * (c1 + c2), (h1 + 0.5 * turn) % 360 if c1 * c2 else h1 + h2
    factors = zip((0.17, -0.24, -0.32, 0.2), (1, 2, 3, 4), (-30, 0, 6, -63), strict=True)
    t = 1 - sum(factor * np.cos(np.radians(times * hue + shift)) for factor, times, shift in factors)
    scales = 1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2), 1 + 0.045 * chroma, 1 + 0.015 * chroma * t
    parts = np.array([l2 - l1, c2 - c1, hue_step]) / scales
    turned = np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2)))
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(turned)
    return float(np.sqrt(parts @ parts + rotation * parts[1] * parts[2]))


def closest(colours):
    """Return the least difference of any two colours in each kind of vision."""
    pairs = list(itertools.combinations(colours, 2))
    return {kind: min(ciede2000(lab(a, kind), lab(b, kind)) for a, b in pairs) for kind in VISION}
