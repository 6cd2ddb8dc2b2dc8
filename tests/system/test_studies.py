"""The command scattering, and detect without a receiver."""

import re

import pytest
import xarray as xr
from command_line import assert_refused, run
from few_paths import few_paths
from rows import each_case

NEAR = ["-D", "surface_size=60", "-D", "bin_width_ns=2", "-D", "bin_count=85"]


@pytest.fixture
def scene(tmp_path):
    """File of a scene with a target, of few paths a pass."""
    return few_paths("fig13_2x2", tmp_path)


def texts(plot):
    """Return the texts of an SVG figure, which matplotlib adds as comments."""
    return set(re.findall(r"<!-- (.*?) -->", plot.read_text(encoding="utf-8")))


@pytest.mark.slow
def test_signal_without_a_receiver(scene, tmp_path):
    """A map of 2x2 places, whose sums are the signals of these places alone."""
    few = [*NEAR, "--receiver", "none", "--passes", 16, "-q", "-o"]
    done = run("detect", scene, "--grid", 2, "--max-offset", 0.5, *few, tmp_path / "map.png")
    assert done.exit_code == 0, done.stderr
    assert done.stdout.splitlines()[2].split()[:2] == ["target_x", "target_y"]
    at_place = ["-D", "target_x=0.5", "-D", "target_y=-0.5"]
    assert run("detect", scene, *at_place, *few, tmp_path / "place.png").exit_code == 0
    with (
        xr.open_dataset(tmp_path / "map.nc", engine="h5netcdf") as found,
        xr.open_dataset(tmp_path / "place.nc", engine="h5netcdf") as own,
    ):
        place = found["combined_echo"].sel(target_x=0.5, target_y=-0.5)
        assert place.sel(combination="sum") == own["combined_echo"].sel(combination="sum")


@pytest.mark.slow
@each_case(
    (["--depths", "2,5"], ["2", "5"], "distance from the centroid (m)"),
    (["--fov-mrad", "20,35", "--passes", 8], ["20", "35"], "field of view (mrad)"),
)
def test_other_scattering(words, heads, drawn, scene, tmp_path):
    plot = tmp_path / "light.svg"
    done = run("scattering", scene, *NEAR, *words, "-o", plot, "-q")
    assert done.exit_code == 0, done.stderr
    firsts = [line.split()[0] for line in done.stdout.splitlines()[3:]]
    assert [first for first in firsts if first in heads] == heads
    assert drawn in texts(plot)
    assert_refused(run("scattering", scene, *words, "--orders", 2), "orders = 2 and ", "are alternatives")
    assert_refused(run("scattering", scene, "--fov-mrad", 20, "--passes", 3), "passes = 3 must")
