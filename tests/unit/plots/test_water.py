"""Figures of waters: without scattering, and their files."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.water.profiles import Profile
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.plots.water import plot_phase_function, plot_profile
from mitransient_lidar.studies.water_report import fournier_forand_of

DEPTH = np.array([1.0, 4.0, 6.0, 10.0])
A = np.array([0.1, 0.3, 0.05, 0.05])
B = np.array([0.2, 0.6, 0.1, 0.1])


def test_a_backscatter_ratio_out_of_range_is_rejected():
    with pytest.raises(UserError, match=r"backscatter_ratio = 0\.6 must lie between"):
        fournier_forand_of(0.6)


@pytest.mark.slow
@pytest.mark.parametrize("b", [[0, 0, 0, 0], [0.1, 0, 0, 0.2]])
def test_water_without_scattering_is_drawn(tmp_path, b):
    profile = Profile(DEPTH, A, b, [0.02 * value for value in b])
    left, right = plot_profile(profile, profile.layers(0.05), "clear", tmp_path / "a.png").axes
    assert 1e-7 < left.get_xlim()[0] < 0.06
    assert len(right.lines) == (1 if any(b) else 0)
    assert [text.get_text() for text in right.texts] == ([] if any(b) else ["no backscattering"])


@pytest.mark.slow
def test_vacuum_is_drawn(tmp_path):
    profile = Profile([0, 1], [0, 0], [0, 0], [0, 0])
    left, right = plot_profile(profile, profile.layers(), "vacuum", tmp_path / "a.svg").axes
    assert (left.get_ylim(), len(right.lines)) == ((1, 0), 0)
    assert [line.get_label() for line in left.lines] == ["c", "b", "a", "bb"]
    assert all(not line.get_xdata().any() for line in left.lines)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_files_are_complete_and_no_others_are_left(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    figure = plot_phase_function(water_phase_function, "this", "$a$b$ {", path)
    assert isinstance(figure, Figure)
    assert path.read_bytes().startswith({"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[suffix])
    assert [other.name for other in tmp_path.iterdir()] == [path.name]


@pytest.mark.slow
def test_wrong_files_are_rejected_and_nothing_is_left(tmp_path):
    profile = Profile(DEPTH, A, B, 0.02 * B)
    with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
        plot_profile(profile, profile.layers(), "x", tmp_path / "a.txt")
    with pytest.raises(UserError, match=r"cannot write .*missing/a\.png: No such file"):
        plot_phase_function(water_phase_function, "this", "x", tmp_path / "missing" / "a.png")
    assert not list(tmp_path.iterdir())
