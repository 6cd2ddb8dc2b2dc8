"""Where to shoot: slopes under the beam, the picture of them, and how echoes go with them."""

import math
from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from command_line import assert_refused, run
from few_paths import few_paths
from significance import largest_z

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import scenes
from mitransient_lidar.studies import find_shots as shots
from mitransient_lidar.studies import shot_statistics

WAVES = {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15}


@pytest.fixture(scope="module")
def sea():
    return shots.SeaMap.of_scene(scenes.open_scene("fig09_2x2", WAVES).scene)


@pytest.mark.slow
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
            assert abs(drawn.mean() - mean) < largest_z(drawn.size, 4) * drawn.std() / 200 + 0.002


@pytest.mark.slow
def test_each_kind_of_shot_has_the_slope_that_it_is_named_for(sea):
    found = shots.find_shots("fig09_2x2", WAVES, slope_sigmas=1.5, count=3, waveforms=False).shots
    assert [shot.kind for shot in found] == [kind for kind in shots.SLOPE_KINDS for _ in range(3)]
    spread = sea.along.std(), sea.across.std()
    for shot in found:
        wanted = shots.SLOPE_KINDS[shot.kind]
        assert shot.along == pytest.approx(1.5 * wanted[0] * spread[0], abs=0.1 * spread[0])
        assert shot.across == pytest.approx(1.5 * wanted[1] * spread[1], abs=0.1 * spread[1])
        assert sea.slope_at(shot.x, shot.y) == pytest.approx((shot.along, shot.across))
    for first, second in pairwise(found):
        if first.kind == second.kind:
            assert math.hypot(first.x - second.x, first.y - second.y) > 4


@pytest.mark.slow
def test_an_interrupted_search_draws_the_shots_that_were_rendered(tmp_path, monkeypatch):
    render_shots, seen = shots.render_shots, {}

    def interrupted(*args, positions, **options):
        seen.update(options)
        return render_shots(*args, positions=positions[:2], **options).assign_attrs(interrupted=1)

    monkeypatch.setattr(shots, "render_shots", interrupted)
    scene, picture = few_paths("fig09_2x2", tmp_path), tmp_path / "sea.png"
    places = [part for x in (0, 3, 6) for part in ("--at", f"{x},1")]
    done = run("find-shots", scene, *places, "--max-time", "500", "-o", picture)
    assert done.exit_code == 130, done.stderr
    assert picture.is_file()
    assert seen["max_time"] == 500
    assert [line.split()[0] for line in done.stdout.splitlines()[2:5]] == ["shot"] * 3


@pytest.mark.slow
def test_depth_bias_is_that_of_a_ray_through_the_slope():
    """A ray traced with vectors through a tilted plane that meets it at the mean level, down to the bottom."""
    for slope in (-0.12, 0.0, 0.05):
        normal = np.array([-slope, 1.0]) / math.hypot(slope, 1)
        ray = np.array([math.sin(0.35), -math.cos(0.35)])
        cosine = -ray @ normal
        down = ray / 1.34 + (cosine / 1.34 - math.sqrt(1 - (1 - cosine**2) / 1.34**2)) * normal
        level = math.cos(math.asin(math.sin(0.35) / 1.34))
        expected = 5.0 / -down[1] * level - 5.0
        assert shot_statistics.depth_bias(np.array([slope]), 5.0, 0.35, 1.34)[0] == pytest.approx(expected, abs=1e-12)
    assert shot_statistics.depth_bias(np.array([-0.1]), 5.0, 0.35, 1.34)[0] < -0.03


@pytest.mark.long
def test_survey_measures_every_shot_and_its_command_draws(tmp_path):
    options = [part for name, value in WAVES.items() for part in ("-D", f"{name}={value}")]
    target = tmp_path / "out" / "survey.png"
    scene = few_paths("fig09_2x2", tmp_path)
    series = tmp_path / "out" / "shots.nc"
    done = run("shots", scene, *options, "--count", 5, "-q", "-o", series, "--figure", target)
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[:3] == [str(series), str(target), str(target.with_suffix(".nc"))]
    assert "correlation of strength with the slope" in done.stdout
    with xr.open_dataset(target.with_suffix(".nc"), engine="h5netcdf") as found:
        assert dict(found.sizes) == {"shot": 5, "pixel": 4}
        place = {**WAVES, "aim_x": float(found.aim_x[2]), "aim_y": float(found.aim_y[2])}
        again = mitransient_lidar.render(scene, params=place, passes=8, seed=2)
        peak = again.waveform.sel(time=slice(1409.9, 1429.9)).max("time")
        known = np.isfinite(found.surface_peak[2].values)
        # A parabola through three bins of 1 ns lies up to a percent above the highest.
        np.testing.assert_allclose(found.surface_peak[2].values[known], peak.values[known], rtol=0.02)


@pytest.mark.slow
def test_invalid_input_is_refused(tmp_path):
    with pytest.raises(UserError, match="every shot on a flat sea is the same"):
        shots.find_shots("fig09_2x2", {"spectrum": "flat"})
    with pytest.raises(UserError, match="must hold 14"):
        shot_statistics.shot_statistics(
            shots.render_shots(few_paths("fig09_2x2", tmp_path), {**WAVES, "bin_count": 40}, count=2)
        )
    for arguments, message in (
        (["find-shots", "fig09_2x2", "--at", "3;4"], "--at = '3;4' must hold numbers only"),
        (["find-shots", "fig09_2x2", "--slope-sigmas", "-1"], "--slope-sigmas = -1 must be"),
        (["shots", "fig09_2x2", "--figure", "survey.txt"], "must end in"),
        (["shots", "fig09_2x2", "--figure", "output/shots.png"], "which holds the shots: give it another name"),
        (["find-shots", "fig09_2x2", "-o", "shots.txt"], "must end in"),
    ):
        assert_refused(run(*arguments), message)


@pytest.mark.slow
def test_shots_command_lists_places(tmp_path):
    places = ["--at", "1.5,-2", "--at", "3,4", "--no-waveforms", "-o", tmp_path / "shots.png"]
    done = run("find-shots", "fig09_2x2", "-D", "wind_speed=6", *places)
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[0] == str(tmp_path / "shots.png")
    assert lines[1].split()[:3] == ["kind", "aim_x", "aim_y"]
    assert lines[2].split()[:4] == ["shot", "1", "1.50", "-2.00"]
    assert len(lines) == 4
