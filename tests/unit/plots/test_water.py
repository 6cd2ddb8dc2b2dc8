"""Figures of waters: which curves, at which angles and depths."""

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


def curve(ax, label):
    (line,) = [line for line in ax.lines if line.get_label() == label]
    return line.get_xdata(), line.get_ydata()


def test_phase_function_is_drawn_with_two_others():
    figure = plot_phase_function(fournier_forand_of(0.0183), "this", "water")
    whole, backward = figure.axes
    assert (whole.get_xscale(), whole.get_yscale(), backward.get_yscale()) == ("log", "log", "log")
    assert whole.get_xlim() == (0.01, 180)
    assert backward.get_xlim() == (90, 180)
    for ax, first in ((whole, 0.01), (backward, 90)):
        assert len(ax.lines) == 3
        for line in ax.lines:
            assert (line.get_xdata()[0], line.get_xdata()[-1]) == pytest.approx((first, 180))
    # Mobley et al. (1993), table 2: 3.154e-3 at 180 degrees, here over 0.9929; radians for degrees would give 3e-1.
    assert curve(backward, "Petzold's average particle")[1][-1] == pytest.approx(3.154e-3 / 0.9929, rel=1e-3)
    # Zhang, Hu and He (2009): 2.2975e-4 / 0.001962 at 180 degrees.
    assert curve(whole, "pure sea water")[1][-1] == pytest.approx(0.1171, rel=1e-3)
    # A Fournier-Forand function of Petzold's bb/b is within a quarter of his from 0.1 to 1 degree.
    angles, values = curve(whole, "this")
    assert np.interp(0.1, angles, values) == pytest.approx(1767, rel=0.25)
    assert np.interp(1.0, angles, values) == pytest.approx(71.6, rel=0.25)


def test_pure_sea_water_is_drawn_once():
    whole, _ = plot_phase_function(water_phase_function, "this", "water").axes
    assert [line.get_label() for line in whole.lines] == ["Petzold's average particle", "this"]


def test_a_backscatter_ratio_out_of_range_is_rejected():
    with pytest.raises(UserError, match=r"backscatter_ratio = 0\.6 must lie between"):
        fournier_forand_of(0.6)


def test_profile_is_lines_and_its_layers_are_steps():
    profile = Profile(DEPTH, A, B, 0.02 * B)
    layers = profile.layers(0.1)
    left, right = plot_profile(profile, layers, "station").axes
    assert left.get_ylim() == (10, 0)
    assert left.get_xscale() == "log"
    # At 2.5 m, half-way between two nodes, and above the first node.
    for name, middle, above in (("a", 0.2, 0.1), ("b", 0.4, 0.2), ("c", 0.6, 0.3), ("bb", 0.008, 0.004)):
        values, depths = curve(left, name)
        assert np.interp(2.5, depths, values) == pytest.approx(middle, rel=1e-9)
        assert values[0] == pytest.approx(above)
        assert (depths[0], depths[-1]) == (0, 10)
    steps = [patch.get_data() for patch in left.patches]
    assert len(steps) == 4
    for data in steps:
        assert data.edges[0] == 0
        assert data.edges[-1] == 10
    # The sum of the steps' areas is the optical depth: 0.3 * 1 + 0.6 * 3 + 0.525 * 2 + 0.15 * 4.
    areas = [np.sum(data.values * np.diff(data.edges)) for data in steps]
    assert max(areas) == pytest.approx(3.75, rel=1e-6)
    # One bb/b everywhere: one function, and no marks of depths.
    assert len(right.lines) == 1
    assert len(left.lines) == 4
    assert right.get_legend().get_texts()[0].get_text() == "0.0200"
    assert left.get_legend().get_title().get_text().endswith(f"bands: {layers.count} layers")


def test_phase_functions_of_layers_cover_the_range_and_are_marked():
    ratio = np.array([0.005, 0.02, 0.01, 0.04])
    profile = Profile(DEPTH, A, B, ratio * B)
    left, right = plot_profile(profile, profile.layers(0.02), "station").axes
    assert len(right.lines) == 8
    marks = [line for line in left.lines if line.get_marker() == "<"]
    depths = [float(mark.get_ydata()[0]) for mark in marks]
    assert depths == sorted(depths)
    assert [mark.get_color() for mark in marks] == [line.get_color() for line in right.lines]
    assert len({mark.get_color() for mark in marks}) == 8
    ratios, layer_tops = zip(
        *(line.get_label().removesuffix(" m").split(" from ") for line in right.lines), strict=True
    )
    assert (min(map(float, ratios)), max(map(float, ratios))) == pytest.approx((0.005, 0.04), rel=0.03)
    assert [float(top) for top in layer_tops] == pytest.approx(depths, rel=5e-3)
    # The more goes backwards, the higher the curve at 180 degrees.
    by_ratio = sorted(right.lines, key=lambda line: float(line.get_label().split()[0]))
    assert np.all(np.diff([line.get_ydata()[-1] for line in by_ratio]) > 0)


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
