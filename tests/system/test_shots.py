"""Where to shoot: slopes under the beam, the picture of them, and how echoes go with them."""

import math
from itertools import pairwise

import numpy as np
import pytest
from typer.testing import CliRunner

import mitransient_lidar
from mitransient_lidar import loading, shots, survey
from mitransient_lidar.cli import app
from mitransient_lidar.errors import UserError

WAVES = {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15}


@pytest.fixture(scope="module")
def sea():
    return shots.SeaMap.of_scene(loading.load_scene("fig09_2x2", WAVES)[0])


def test_slopes_are_means_over_the_footprint(sea):
    """Against random points of a Gaussian of the footprint's mean radius, 1.1 m, on the heights themselves."""
    rng = np.random.default_rng(4)
    spacing = sea.x[1] - sea.x[0]
    radius = 1.064 / math.sqrt(math.cos(math.radians(20)))
    for x, y in ((sea.x[200], sea.y[10]), (sea.x[470], sea.y[333])):
        i, j = (np.rint((place + rng.normal(0, radius, 40_000) - lines[0]) / spacing).astype(int) % len(lines)
                for place, lines in ((x, sea.x), (y, sea.y)))  # fmt: skip
        right = (sea.heights[j, (i + 1) % len(sea.x)] - sea.heights[j, i - 1]) / (2 * spacing)
        up = (sea.heights[(j + 1) % len(sea.y), i] - sea.heights[j - 1, i]) / (2 * spacing)
        for drawn, mean in zip((right, up), sea.slope_at(x, y), strict=True):
            assert abs(drawn.mean() - mean) < 4 * drawn.std() / 200 + 0.002


def test_each_kind_of_shot_has_the_slope_that_it_is_named_for(sea):
    found = shots.find_shots("fig09_2x2", WAVES, steepness=1.5, count=3)
    assert [shot.kind for shot in found] == [kind for kind in shots.KINDS for _ in range(3)]
    spread = sea.along.std(), sea.across.std()
    for shot in found:
        wanted = shots.KINDS[shot.kind]
        assert shot.along == pytest.approx(1.5 * wanted[0] * spread[0], abs=0.1 * spread[0])
        assert shot.across == pytest.approx(1.5 * wanted[1] * spread[1], abs=0.1 * spread[1])
        assert sea.slope_at(shot.x, shot.y) == pytest.approx((shot.along, shot.across))
    for first, second in pairwise(found):
        if first.kind == second.kind:
            assert math.hypot(first.x - second.x, first.y - second.y) > 4


def test_a_face_towards_the_lidar_shines_and_gathers_its_echoes(tmp_path):
    """The published effects: a stronger surface echo, whose far pair comes sooner after the near pair."""
    found = shots.find_shots("fig09_2x2", WAVES, steepness=1.5)
    towards, level, away, _ = shots.plot_shots("fig09_2x2", found, tmp_path / "shots.png", WAVES)
    assert (tmp_path / "shots.png").stat().st_size > 50_000
    peaks = [float(shot.waveform.sel(time=slice(1405, 1435)).max("time").sum()) for shot in (towards, level, away)]
    assert peaks[0] > 4 * peaks[1]
    assert peaks[1] > peaks[2]
    # The surface tilts with its face: over the two pairs' distance of 1.2 m that is nanoseconds.
    bottom = [shot.waveform.sel(time=slice(1450, 1480)).idxmax("time").values for shot in (towards, level, away)]
    assert bottom[2].mean() < bottom[1].mean() < bottom[0].mean()


def test_depth_bias_is_that_of_a_ray_through_the_slope():
    """A ray traced with vectors through a tilted plane that meets it at the mean level, down to the bottom."""
    for slope in (-0.12, 0.0, 0.05):
        normal = np.array([-slope, 1.0]) / math.hypot(slope, 1)
        ray = np.array([math.sin(0.35), -math.cos(0.35)])
        cosine = -ray @ normal
        down = ray / 1.34 + (cosine / 1.34 - math.sqrt(1 - (1 - cosine**2) / 1.34**2)) * normal
        level = math.cos(math.asin(math.sin(0.35) / 1.34))
        expected = 5.0 / -down[1] * level - 5.0
        assert survey.depth_bias(np.array([slope]), 5.0, 0.35, 1.34)[0] == pytest.approx(expected, abs=1e-12)
    assert survey.depth_bias(np.array([-0.1]), 5.0, 0.35, 1.34)[0] < -0.03


def test_survey_measures_every_shot_and_its_command_draws(tmp_path):
    options = [part for name, value in WAVES.items() for part in ("-D", f"{name}={value}")]
    target = tmp_path / "out" / "survey.png"
    done = CliRunner().invoke(app, ["survey", "fig09_2x2", *options, "--count", "5", "-q", "-o", str(target)])
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[:2] == [str(target), str(target.with_suffix(".nc"))]
    assert "correlation of strength with the slope" in done.stdout
    import xarray as xr

    with xr.open_dataset(target.with_suffix(".nc")) as found:
        assert dict(found.sizes) == {"shot": 5, "pixel": 4}
        place = {**WAVES, "shot_x": float(found.shot_x[2]), "shot_y": float(found.shot_y[2])}
        again = mitransient_lidar.render("fig09_2x2", params=place, passes=8, seed=2)
        peak = again.waveform.sel(time=slice(1409.9, 1429.9)).max("time")
        known = np.isfinite(found.surface_peak[2].values)
        # A parabola through three bins of 1 ns lies up to a percent above the highest.
        np.testing.assert_allclose(found.surface_peak[2].values[known], peak.values[known], rtol=0.02)


def test_mistakes_are_told():
    with pytest.raises(UserError, match="every shot on a flat sea is the same"):
        shots.find_shots("fig09_2x2", {"spectrum": "flat"})
    with pytest.raises(UserError, match="must hold 14"):
        survey.survey("fig09_2x2", {**WAVES, "bin_count": 40}, count=2)
    run = CliRunner().invoke
    for arguments, message in (
        (["shots", "fig09_2x2", "--at", "3;4"], "--at 3;4 is not of the form x,y"),
        (["shots", "fig09_2x2", "--steepness", "-1"], "--steepness -1.0 is out of range"),
        (["shots", "fig09_2x2", "--count", "0"], "--count 0 is out of range"),
        (["survey", "fig09_2x2", "--count", "1"], "--count 1 is out of range"),
        (["survey", "fig09_2x2", "-o", "survey.txt"], "must end in"),
    ):
        done = run(app, arguments)
        assert done.exit_code == 2
        assert message in done.stderr
        assert done.stdout == ""


def test_shots_command_lists_places():
    done = CliRunner().invoke(app, ["shots", "fig09_2x2", "-D", "wind_speed=6", "--at", "1.5,-2", "--at", "3,4"])
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[0].split()[:3] == ["kind", "shot_x", "shot_y"]
    assert lines[1].split()[:4] == ["shot", "1", "1.50", "-2.00"]
    assert len(lines) == 3
