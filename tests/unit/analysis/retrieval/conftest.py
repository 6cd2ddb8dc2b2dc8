"""Water of synthetic shots, which scatters light once."""

import numpy as np
import pytest

from mitransient_lidar.analysis.retrieval import scattered_light

LEVEL = 1.13  # of the columns of `synthetic_shots` over that of bb


def light_of(view, decay, backscatter, path, weights, deepest, ratio):
    """Column and bottom decay alike, with a + bb, and the column ends at the bottom."""
    bb = 2 * np.pi * backscatter / LEVEL
    at = np.linspace(0, 2 * deepest, 2001)
    column = np.where(at < deepest, LEVEL * np.exp(-2 * bb * at), 0.0)
    return scattered_light.ScatteredLight(decay - bb, bb, at, column, at, -2 * bb * at, path, LEVEL, bb, LEVEL)


@pytest.fixture
def scattered_once(monkeypatch):
    monkeypatch.setattr(scattered_light, "light_of", light_of)
