"""Gates in renders: against the waveform, against one another, and where geometry puts a target."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracles.gates import transmission
from rows import each_case, must_refuse, refuses
from scipy.ndimage import gaussian_filter
from significance import largest_z

import mitransient_lidar
from mitransient_lidar.analysis.gates import cut as gating
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.rendering import accumulators
from mitransient_lidar.results import gate_stack
from mitransient_lidar.transport.paths.histogram import TransientHistogram
from mitransient_lidar.transport.scene_parts import find_lidar_scene

#: Bytes of the histogram of four pixels and 300 bins, with its means and errors.
HISTOGRAM = 4 * 300 * 116
WAVES = {"spectrum": "elfouhaily", "wind_speed": 8.0, "slope_variance": "cox_munk"}
GATES = {"gate_start_ns": 1425.0, "gate_width_ns": 8.0, "gate_step_ns": 5.0, "gate_count": 20, "gate_rise_ns": 2.0}


def gated(lidar_scene, integrator="lidar_merging", film=None, **more):
    options = {"type": integrator, "paths_per_pass": 2**14}
    if integrator == "lidar_merging":
        options["photons_per_pass"] = 2**13
    return lidar_scene(
        integrator=options, film={"bin_width_ns": 0.5, "bin_count": 300, **GATES, **(film or {})}, **more
    )


def render(scene, gigabytes=2.0, passes=4, **options):
    return mitransient_lidar.render(scene, passes=passes, seed=3, max_memory=gigabytes, **options)


@pytest.mark.slow
def test_gates_are_the_waveform_behind_a_shutter(lidar_scene):
    """The integral of power times transmission; a gate shifted by half a bin would differ by per cents at its edges."""
    result = render(gated(lidar_scene))
    time = result["time"].values
    for gate, opens in enumerate(result["gate_start"].values):
        train = GateTrain(opens, 8.0, 1.0, 1, rise_ns=2.0)
        # Bins are short against pulse and edges: power is linear, and the shutter sampled, within each.
        fine = np.linspace(time[0], time[-1], 20 * len(time))
        power = np.array([np.interp(fine, time, pixel) for pixel in result["waveform"].values])
        energy = np.trapezoid(power * transmission(train.shape, fine - train.start_ns), 1e-9 * fine, axis=1)
        np.testing.assert_allclose(result["gate_energy"].values[:, gate], energy, rtol=0.01)


@pytest.mark.slow
def test_recut_gates_are_those_of_the_render(lidar_scene):
    """Energies, and their derivatives with the light."""
    names = ["attenuation", "bottom_reflectance"]
    result = render(gated(lidar_scene, "lidar_volpath"), passes=16, derivatives=names)
    options = {"start_ns": 1425.0, "width_ns": 8.0, "step_ns": 5.0, "count": 20, "rise_ns": 2.0}
    cut = gating.cut_gates(result, gate_stack.train_from_options(result.attrs, **options))
    np.testing.assert_allclose(cut["gate_energy"], result["gate_energy"], rtol=0.01)
    assert result["gate_energy_derivative"].dims == ("parameter", "pixel", "gate")
    largest = abs(result["gate_energy_derivative"]).max("gate")
    difference = cut["gate_energy_derivative"] - result["gate_energy_derivative"]
    assert float((abs(difference) / largest).max()) < 0.01
    # The error is that of the passes within the inflation of sums over bins, which is one for the whole record.
    for name in ("gate_energy", "gate_energy_derivative"):
        lit = result[f"{name}_stderr"] > 0
        ratio = (cut[f"{name}_stderr"] / result[f"{name}_stderr"]).where(lit)
        assert 0.7 < float(ratio.median()) < 1.4, name


@each_case(pytest.param("lidar_merging", marks=pytest.mark.long), pytest.param("lidar_volpath", marks=pytest.mark.slow))
def test_short_memory_gives_the_same_gates(integrator, lidar_scene, caplog):
    """The same paths: cut from each pass in 32 bits, or summed where they arrive, exact to the bin's width."""
    pulses = {"pulses": 10}
    whole = render(gated(lidar_scene, integrator, pulses))
    assert not caplog.records
    for share, rtol, words in ((0.5, 2e-6, "gates are kept, histograms are not"), (0.2, 0.05, "summed directly")):
        result = render(gated(lidar_scene, integrator, pulses), gigabytes=1e-9 * share * HISTOGRAM)
        assert words in caplog.text
        assert "waveform" not in result
        assert result.attrs["pulses"] == 10
        energy, expected = result["gate_energy"].values, whole["gate_energy"].values
        # Half a bin matters most where a few paths arrive at the edge of a gate.
        np.testing.assert_allclose(energy, expected, rtol=rtol, atol=1e-3 * expected.max(), err_msg=words)
    ten = gated(lidar_scene, integrator)
    np.testing.assert_allclose(10 * render(ten)["gate_energy"], whole["gate_energy"], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, pytest.param(0.2, marks=pytest.mark.long)])
def test_non_finite_energy_is_reported(lidar_scene, monkeypatch, caplog, share):
    """The light of pixel green is NaN; the other pixels keep theirs, in both ways of keeping gates alone."""
    scene = gated(lidar_scene)
    add = TransientHistogram.add_at

    def spoil(self, pixel, number, energy, active, sums):
        add(self, pixel, number, dr.select(pixel == 1, dr.nan, energy), active, sums)

    monkeypatch.setattr(TransientHistogram, "add_at", spoil)
    result = render(scene, gigabytes=1e-9 * share * HISTOGRAM, passes=2)
    finite = np.isfinite(result["gate_energy"]).any("gate").values
    assert finite.tolist() == [True, False, True, True]
    assert "gates of 1 of 4 pixels hold values that are not finite" in caplog.text


@pytest.mark.parametrize("changes", [{}, {"rx": {"field_of_view_mrad": 100.0}}, {"sea": WAVES}])
def test_gates_by_depth_open_with_an_echo_from_there(lidar_scene, changes):
    """Whatever the view and the waves: the depth is that below the mean sea level on the axis."""
    gates = {"gate_start_depth": 3.0, "gate_width_ns": 8.0, "gate_count": 6}
    scene = lidar_scene(film={"bin_width_ns": 0.5, "bin_count": 300, **gates}, **changes)
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    train = lidar.gate_train(lidar.gates)
    angle, in_water = np.radians(20.0), np.arcsin(np.sin(np.radians(20.0)) / 1.34)
    expected = 2e9 / C0 * (200.0 / np.cos(angle) + 1.34 * 3.0 / np.cos(in_water))
    assert train.start_ns == pytest.approx(expected, abs=1e-3)
    # By default the next gate opens a width later; the middle of the first one is 4 ns after its start.
    assert train.starts_ns[1] == pytest.approx(expected + 8.0, abs=1e-3)
    lidar = {"altitude": 200.0, "off_nadir_deg": 20.0, "refractive_index": 1.34, "group_index": 1.34}
    assert gate_stack.gate_depths(train, lidar)[0] == pytest.approx(3.0 + 4.0 / 9.24576, abs=1e-4)


@pytest.mark.slow
def test_gates_narrower_than_bins_are_exact(lidar_scene):
    """The same paths in bins of 5 ns and of 0.1 ns, whose gates of 1 ns differed by a third; with derivatives."""
    gates = {"gate_start_range": 211.0, "gate_width_ns": 1.0, "gate_step_ns": 2.0, "gate_count": 40}
    paths = {"paths_per_pass": 2**13}
    fine, coarse = (
        render(
            lidar_scene(integrator=paths, film={**gates, "gate_jitter_ns": 0.2, **bins}), derivatives=["attenuation"]
        )
        for bins in ({"bin_width_ns": 0.1, "bin_count": 1500}, {"bin_width_ns": 5.0, "bin_count": 30})
    )
    assert fine.attrs["gate_jitter_ns"] == 0.2
    assert fine["gate_start"].values[0] == pytest.approx(2e9 / C0 * 211.0, abs=1e-3)
    for name in ("gate_energy", "gate_energy_derivative"):
        difference = np.abs(coarse[name] - fine[name]).max("gate") / np.abs(fine[name]).max("gate")
        assert float(difference.max()) < 0.01


def test_gates_by_depth_need_an_axis_that_meets_the_sea(lidar_scene):
    pose = {"altitude": -5.0, "off_nadir_deg": 90.0}
    scene = lidar_scene(film={"gate_start_depth": 3.0, "gate_count": 2}, tx=pose, rx=pose)
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    for one, words in ((lidar, "the axis of the receiver"), (replace(lidar, surfaces=[]), "the scene has none")):
        with pytest.raises(UserError, match=f"gate_start_depth = 3 m .* sea level, and {words}.*: give gate_start_ns"):
            one.gate_train(one.gates)


@pytest.mark.slow
@refuses(
    ({"gate_start_ns": 1391.0, "gate_count": 2}, 2.0, "before the surface"),
    ({"gate_start_ns": 1500.0, "gate_count": 20}, 2.0, "must lie within the record"),
    ({}, 1e-9 * 4 * 38 * 0.5, "max_memory .* is less than one gate needs"),
    ({}, 1e-9 * 4 * 38 * 3.5, "max_memory .* is room for 3 of them"),
    ({"gate_count": 0}, 1e-9 * HISTOGRAM * 0.5, r"more than max_memory .* take fewer bins or pixels, or gates"),
    ({}, 0.0, "max_memory = 0 must be greater than 0"),
)
def test_gates_that_cannot_be(film, gigabytes, lidar_scene):
    render(gated(lidar_scene, film=film), gigabytes, passes=2)


@each_case(
    ({"gate_width_ns": 0.0}, "gate_width_ns = 0"),
    ({"gate_step_ns": -1.0}, "gate_step_ns = -1"),
    ({"gate_count": -1}, "gate_count = -1"),
    ({"gate_start_depth": 3.0}, "and gate_start_depth = 3.0 describe the same"),
    ({"pulses": 0}, "pulses = 0"),
    ({"gate_profile": "missing.txt"}, "gate_width_ns = 8.0 and gate_profile = 'missing.txt' describe the same"),
)
def test_parameters_of_gates_out_of_range(film, words):
    with pytest.raises(Exception, match=words):
        mi.load_dict({"type": "time_gated_film", **GATES, **film})


@pytest.mark.slow
def test_smoothed_images_are_those_of_other_passes_smoothed(lidar_scene):
    """Against eight renders that are smoothed afterwards, within the errors that smoothed passes state."""
    scene = gated(lidar_scene, film={"gate_count": 8, "gate_step_ns": 10.0}, rx={"layout": "64x64"})
    others = [mitransient_lidar.render(scene, passes=2, seed=seed) for seed in range(11, 19)]
    images = np.array([gaussian_filter(one["gate_energy"].values, 2.0, axes=(0, 1)) for one in others])
    mean, error = images.mean(axis=0), images.std(axis=0, ddof=1) / np.sqrt(8)
    for gigabytes in (2.0, 1e-9 * 62 * 64 * 64 * 8 * 1.01):
        result = render(scene, gigabytes, passes=16, smooth=2.0)
        assert "waveform" not in result
        assert result.attrs["smooth_pixels"] == 2.0
        assert (result["gate_smoothing_bias"] < 0.2).any()
        # Pixels that share little of their light.
        lit = (mean > 0.05 * mean.max(axis=(0, 1)))[::8, ::8]
        own, total = (values[::8, ::8][lit] for values in (result["gate_energy_stderr"].values, mean))
        z = ((result["gate_energy"].values - mean)[::8, ::8][lit]) / np.hypot(error[::8, ::8][lit], own)
        assert np.abs(z).max() < largest_z(8, z.size)
        assert np.sqrt(np.mean(z**2)) < 1.5
        assert np.median(own / total) < 0.1
    with pytest.raises(UserError, match=r"smooth = 2 pixels needs gates in the film, and a layout of rows"):
        render(lidar_scene(), smooth=2.0)
    must_refuse("smooth = 2 keeps gates alone: leave out components", render, scene, smooth=2.0, batches=4)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["maps", "merging"])
def test_tiles_of_pixels_have_the_bits_of_the_whole_image(monkeypatch, light):
    """Rays of another tile, or another tile's random numbers, would change most pixels."""
    params = {"layout": "64x64", "gate_start_ns": 1425, "gate_width_ns": 8, "gate_step_ns": 5, "gate_count": 8}
    found = []
    for tiles in ([None], [range(1500), range(1500, 2100), range(2100, 4096)]):
        monkeypatch.setattr(accumulators, "_tiles", lambda *_, tiles=tiles: (0.0, tiles))
        result = mitransient_lidar.render("fig09_2x2", params, light=light, passes=2, seed=3, max_memory=0.1)
        assert (result["gate_energy_stderr"] > 0).any("gate").mean() > 0.7
        found.append([result[name].values for name in ("gate_energy", "gate_energy_stderr")])
    np.testing.assert_array_equal(*found)


def test_tiles_fit_the_memory_that_is_stated():
    """An image of 10^6 pixels and 40 gates: its means and errors take 0.64 GB, and sums of all pixels 0.8 GB."""
    pixels, of_pass = 10**6, (5e7, 200.0)
    for max_memory, fewest in ((2.5, 1), (1.5, 2), (1.2, 5)):
        size, tiles = accumulators._tiles(pixels, 40, 3e8, of_pass, max_memory)
        assert 0.7 * max_memory < 1e-9 * size <= max_memory
        assert len(tiles) >= fewest
        whole = range(pixels)
        assert [pixel for tile in tiles for pixel in tile or whole] == list(whole)
    with pytest.raises(UserError, match=r"max_memory = 1 GB is less than 40 gates of 1000000 pixels take .*, 1\.18 GB"):
        accumulators._tiles(pixels, 40, 3e8, of_pass, 1.0)
