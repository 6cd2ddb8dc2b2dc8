"""Tables of echoes: dimensions, units, flags, noise, files, the command, and echoes of rendered results."""

import csv

import numpy as np
import pytest
import significance
import xarray as xr
from command_line import assert_refused, run
from scipy.stats import exponnorm, norm
from significance import largest_count, largest_z

from mitransient_lidar import results
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms import csv_tables, echo_table
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag, saturated_spans
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA, Pulse
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results.geometry import LinesOfSight

DT = 0.5
BINS = 320
START = 1380.0
TIME = START + (np.arange(BINS) + 0.5) * DT
EDGES = START + np.arange(BINS + 1) * DT
SIGMA = 5.0 / FWHM_PER_SIGMA
DECAY = 0.035
# At nadir from 200 m with n = n_g = 1.34: no spread over the footprint, and 0.1119 m of water a nanosecond.
SURFACE = 2e9 * 212.84 / 299792458
PER_NS = 0.299792458 / (2 * 1.34)
ATTRIBUTES = {"altitude": 212.84, "off_nadir_deg": 0.0, "refractive_index": 1.34, "group_index": 1.34}
ATTRIBUTES |= {"pulse_fwhm_ns": 5.0, "response_time_ns": 0.0, "surface_time_ns": SURFACE, "layout": "2x2"}
#: Times of the surface in the pixels of `result` [ns], against the mean.
SHIFTS = np.array([2.3, 2.1, -1.8, -2.2])


#: Delays of targets behind the surface [ns], of four waveforms.
PLACES = [[], [40], [40, 28], [44, 34, 54]]


def echo(arrival, energy):
    """Mean power [W] in each bin of an ideal echo of an energy [J]."""
    return energy / (DT * 1e-9) * np.diff(norm.cdf(EDGES, arrival, SIGMA))


def column(start, end, level):
    def onset(at):
        return level / DECAY * exponnorm.pdf(TIME, 1 / (DECAY * SIGMA), loc=at, scale=SIGMA)

    return onset(start) - np.exp(-DECAY * (end - start)) * onset(end)


def waveform(surface=SURFACE, bottom=70.0, target=0.0):
    found = echo(surface, 2e-13) + column(surface, surface + bottom, 3e-5) + echo(surface + bottom, 6e-13)
    return found + (echo(surface + 40, target) if target else 0)


def result(values=None, grid=None, **attributes):
    values = np.stack([waveform(SURFACE + shift) for shift in SHIFTS]) if values is None else values
    count = len(values)
    return results.build(
        values * DT * 1e-9,
        0 * values,
        values,
        0 * values,
        time=TimeAxis(START, DT, BINS),
        pixel_names=["red", "green", "blue", "black"][:count],
        pixel_centres_mrad=np.arange(2.0 * count).reshape(count, 2),
        grid=grid,
        attributes={**ATTRIBUTES, **attributes},
    )


def recorded(clean, shots, noise, seed=1, offset=0.3):
    """Shots of a receiver that turns 1 W into 1e5 V, with an offset."""
    rng = np.random.default_rng(seed)
    signal = offset + 1e5 * clean + noise * rng.normal(size=(shots, *clean.shape))
    base = result(clean)
    return xr.Dataset(
        {"signal": (("shot", "pixel", "time"), signal, {"units": "V"})},
        {**{name: base.coords[name] for name in ("pixel", "angle_x", "angle_y", "time")}, "shot": np.arange(shots)},
        base.attrs,
    )


@pytest.mark.parametrize("estimator", echo_table.ESTIMATORS)
def test_isolated_echoes_without_noise(estimator):
    """Surface and bottom of a lake without a column: times within 0.02 ns, depth within 2 mm."""
    bottom = np.array([50.0, 60.13, 70.29, 80.41])
    values = np.stack([echo(SURFACE + 0.1, 3e-13) + echo(SURFACE + delay, 6e-13) for delay in bottom])
    table = echo_table.extract(result(values), estimator)
    assert table["time_ns"].dims == ("pixel", "echo")
    assert list(table["echo"].values) == list(echo_table.ECHOES)
    surface, seabed = table.sel(echo="surface"), table.sel(echo="bottom")
    np.testing.assert_allclose(surface["time_ns"], SURFACE + 0.1, atol=0.02)
    np.testing.assert_allclose(seabed["time_ns"], SURFACE + bottom, atol=0.02)
    np.testing.assert_allclose(seabed["depth_m"], (bottom - 0.1) * PER_NS, atol=0.004)
    np.testing.assert_allclose(seabed["energy"], 6e-13, rtol=0.02)
    assert (table["flags"].sel(echo=["surface", "bottom"]) == 0).all()
    assert (table["flags"].sel(echo="target") == EchoFlag.NO_ECHO).all()
    assert seabed["energy"].attrs["units"] == "J"
    assert table["amplitude"].attrs["units"] == "W"


def test_surface_column_target_and_bottom_of_every_pixel():
    values = np.stack([waveform(SURFACE + shift, target=2e-13) for shift in SHIFTS])
    table = echo_table.extract(result(values))
    for name, delay in (("surface", 0), ("target", 40), ("bottom", 70)):
        np.testing.assert_allclose(table["time_ns"].sel(echo=name), SURFACE + SHIFTS + delay, atol=0.05)
    np.testing.assert_allclose(table["depth_m"].sel(echo="bottom"), 70 * PER_NS, atol=0.006)
    np.testing.assert_allclose(table["energy"].sel(echo="target"), 2e-13, rtol=0.01)
    # Half of exp(-0.035 t); at 200 m the distance takes 1 % of the decay over these depths, which is taken out.
    np.testing.assert_allclose(table["width_ns"].sel(echo="column"), np.log(2) / DECAY, rtol=0.05)
    np.testing.assert_allclose(table["amplitude"].sel(echo="column"), 3e-5, rtol=0.03)


def test_attenuation_is_along_the_path_without_the_loss_by_distance():
    """K of exp(-2 K s), s the way in the water, behind 1/(n H + s)^2 at nadir."""
    way = np.maximum(TIME - SURFACE, 0) * PER_NS
    signal = np.where(TIME > SURFACE, 3e-5 * np.exp(-2 * 0.2 * way) * (1.34 * 212.84 / (1.34 * 212.84 + way)) ** 2, 0)
    table = echo_table.extract(result(signal[np.newaxis]))
    assert float(table["attenuation"][0]) == pytest.approx(0.2, rel=1e-4)


def test_depths_from_the_mean_surface():
    table = echo_table.extract(result(), depth_from="mean")
    for name, delay in (("surface", 0), ("bottom", 70)):
        np.testing.assert_allclose(table["depth_m"].sel(echo=name) / PER_NS, SHIFTS + delay, atol=0.05)


def test_several_estimators_have_a_dimension_of_their_own():
    table = echo_table.extract(result(), ["peak", "gaussian"])
    assert table["time_ns"].dims == ("pixel", "estimator", "echo")
    one = echo_table.extract(result(), "gaussian")
    xr.testing.assert_equal(table["time_ns"].sel(estimator="gaussian", drop=True), one["time_ns"])
    # On the column, the peak is late.
    late = table["time_ns"].sel(echo="surface", estimator="peak") - one["time_ns"].sel(echo="surface")
    assert (late > 0.5).all()


def lit(dataset, shares):
    """Return a result of pixels that look straight down, with shares of the beam."""
    zeros = np.zeros(len(shares))
    values = (zeros, zeros, zeros, zeros + SURFACE, zeros + 0.1, zeros + PER_NS, np.array(shares))
    return dataset.assign_coords(LinesOfSight(*values).coordinates(("pixel",), (len(shares),)))


def test_a_pixel_without_surface_light_takes_the_surface_of_the_others():
    """Scattered light that rises 9 ns late: as a surface echo, it would make the bottom a metre shallower."""
    late = column(SURFACE + 9, SURFACE + 70, 2e-6) + echo(SURFACE + 70, 3e-14)
    dataset = lit(result(np.stack([waveform()] * 3 + [late])), [0.3, 0.3, 0.3, 1e-7])
    for estimator in ("gaussian", "peak"):
        table = echo_table.extract(dataset, estimator)
        dark = table.isel(pixel=3)
        flags = int(dark["flags"].sel(echo="surface"))
        assert flags & EchoFlag.NO_SURFACE_LIGHT
        assert np.isnan(dark["time_ns"].sel(echo="surface"))
        assert float(dark["surface_time_ns"]) == pytest.approx(float(table["surface_time_ns"][0]), abs=0.01)
        bottoms = table.sel(echo="bottom")
        assert float(bottoms["depth_m"][3] - bottoms["depth_m"][0]) == pytest.approx(0, abs=0.02)
        assert bottoms["depth_m_stderr"][3] > 10 * bottoms["depth_m_stderr"][0]
        assert not (table["flags"].isel(pixel=[0, 1, 2]) & EchoFlag.NO_SURFACE_LIGHT).any()
    # Without shares of the beam, every first echo is the surface.
    unknown = echo_table.extract(result(dataset["waveform"].values))
    assert not (unknown["flags"] & EchoFlag.NO_SURFACE_LIGHT).any()


def test_all_targets_of_a_waveform_are_listed():
    """None, one, two and three targets: the table has as many as the waveform with most, the strongest first."""
    shots = [waveform() + sum(echo(SURFACE + at, 5e-13 / (1 + k)) for k, at in enumerate(places)) for places in PLACES]
    table = echo_table.extract(result(np.stack(shots)))
    names = ["target", "target_2", "target_3"]
    assert table["echo"].values.tolist() == ["surface", "column", *names, "bottom"]
    for pixel, places in enumerate(PLACES):
        own = table.isel(pixel=pixel)
        delay = own["time_ns"].sel(echo=names[: len(places)]).values - SURFACE
        np.testing.assert_allclose(delay, places, atol=0.3)
        assert (own["flags"].sel(echo=names[: len(places)]) == 0).all()
        assert (own["flags"].sel(echo=names[len(places) :]) == EchoFlag.NO_ECHO).all()
        assert float(own["time_ns"].sel(echo="bottom")) - SURFACE == pytest.approx(70, abs=0.1)
    assert echo_table.extract(result(np.stack(shots)), targets=1)["echo"].values.tolist() == list(echo_table.ECHOES)


@pytest.mark.parametrize("rise", [1.5, 3.0])
@pytest.mark.parametrize("echo_behind", [False, True])
def test_the_edge_of_a_turbid_layer_is_no_target(rise, echo_behind):
    """From 35 ns on the column is brighter; a target behind the edge is one, and a target of the same height, too."""
    at = SURFACE + 35
    level = 3e-5 * np.exp(-DECAY * 35)
    upper = echo(SURFACE, 2e-13) + column(SURFACE, SURFACE + 70, 3e-5) + echo(SURFACE + 70, 6e-13)
    layer = upper + column(at, SURFACE + 70, (rise - 1) * level)
    target = upper + echo(at, (rise - 1) * level * 5e-9)
    layer = layer + (echo(SURFACE + 52, 2e-13) if echo_behind else 0)
    first, second = (
        echo_table.extract(result(one[np.newaxis])).isel(pixel=0).sel(echo="target") for one in (layer, target)
    )
    if echo_behind:
        assert float(first["time_ns"]) - SURFACE == pytest.approx(52, abs=0.5)
    else:
        assert int(first["flags"]) == EchoFlag.NO_ECHO
    assert float(second["time_ns"]) - SURFACE == pytest.approx(35, abs=0.5)


def test_a_surface_echo_within_its_error_is_not_listed():
    """The onset of a column without a surface echo, with noise: a time, but no amplitude or energy."""
    bare = column(SURFACE, SURFACE + 70, 3e-5) + echo(SURFACE + 70, 6e-13)
    table = echo_table.extract(recorded(np.stack([bare, waveform()]), 200, 0.02))
    none, some = (table.sel(echo="surface").isel(pixel=pixel) for pixel in (0, 1))
    # An amplitude beyond its error by chance is listed: in 1 % of the shots.
    unlisted = (none["flags"] & EchoFlag.COLUMN_ONSET).values > 0
    assert unlisted.mean() > 0.9
    none = none.isel(shot=unlisted)
    for name in ("amplitude", "energy", "width_ns"):
        assert np.isnan(none[name]).all()
        assert np.isfinite(some[name]).all()
    assert (some["flags"] == 0).all()
    assert np.abs(none["time_ns"] - SURFACE).max() < 2  # a spread of 0.27
    assert np.isfinite(table["depth_m"].sel(echo="bottom")).all()


def test_a_bottom_within_its_error_is_flagged():
    """Bottoms of 230 standard errors, and some of less than 3 that a low threshold finds."""
    normal = np.random.default_rng(3).normal(size=(4, BINS))
    for noise, doubtful in ((1e-6, False), (1e-4, True)):
        dataset = result(np.stack([waveform()] * 4) + noise * normal)
        bottom = echo_table.extract(dataset, noise=noise, threshold=1.0).sel(echo="bottom")
        weak = (bottom["amplitude"] < 3 * bottom["amplitude_stderr"]).values
        assert weak.any() == doubtful
        flagged = (bottom["flags"].values & int(EchoFlag.POOR_FIT)) != 0
        assert flagged[weak].all()
        assert doubtful or not flagged.any()


def test_rows_say_why_a_depth_is_unknown():
    dark = 0 * TIME
    surface_only = echo(SURFACE, 3e-13)
    dataset = lit(result(np.stack([waveform(), dark, surface_only])), [0.4, 0.3, 0.3])
    names, lines = csv_tables.rows(echo_table.extract(dataset))
    cells = [dict(zip(names, line, strict=True)) for line in lines]
    reasons = {(row["pixel"], row["echo"]): row["unknown_depth"] for row in cells}
    assert reasons["red", "bottom"] == ""
    assert reasons["green", "surface"] == "no surface echo"
    assert reasons["blue", "bottom"] == "no bottom echo"
    assert reasons["green", "column"] == "column too short or too noisy"
    assert all((row["unknown_depth"] == "") == np.isfinite(row["depth_m"]) for row in cells)
    saturated = int(EchoFlag.SATURATED | EchoFlag.POOR_FIT)
    assert csv_tables.unknown_depth("bottom", saturated, True) == "saturated"
    assert csv_tables.unknown_depth("bottom", 0, False) == "no surface echo"
    assert csv_tables.flag_names(0) == ""
    assert csv_tables.flag_names(int(EchoFlag.SATURATED | EchoFlag.MERGED)) == "saturated merged"


def test_imager_and_blocks_give_the_same_as_pixels():
    flat = echo_table.extract(result())
    image = echo_table.extract(result(grid=(2, 2)), block=3)
    assert image["time_ns"].dims == ("row", "column", "echo")
    np.testing.assert_array_equal(image["time_ns"].values.reshape(4, 4), flat["time_ns"].values)
    assert "angle_x" in image.coords


def test_shots_of_a_receiver_have_true_errors():
    """600 shots: scatter against stated errors, offset removed, energies in V s."""
    dataset = recorded(np.stack([waveform(), waveform(bottom=75.3)]), 600, 0.05)
    table = echo_table.extract(dataset)
    assert table["time_ns"].dims == ("shot", "pixel", "echo")
    assert table["energy"].attrs["units"] == "V s"
    for name, truth in (("surface", [0, 0]), ("bottom", [70.0, 75.3])):
        time_ns, error = table["time_ns"].sel(echo=name), table["time_ns_stderr"].sel(echo=name)
        off = time_ns - SURFACE - truth
        # In one of 100 sets noise is a first peak.
        real = np.abs(off) < 5
        assert (~real).sum() <= largest_count(1200, 1e-5)
        z = (off / error).where(real)
        assert np.abs(z.std("shot") - 1).max() < largest_z(600) / np.sqrt(2 * 600) + 0.05
        assert np.abs(off.where(real).mean("shot")).max() < 0.03
    energy = table["energy"].sel(echo="bottom")
    assert float(energy.mean()) == pytest.approx(6e-13 * 1e5, rel=0.01)


@pytest.mark.slow
def test_signals_behind_a_logarithm_are_expanded():
    """Echoes of a tenth of the light have a tenth of the energy, as behind the same photomultiplier without logarithm.

    Ten times the light would saturate the linear one. Behind the logarithm it is 0.25 V more, of 0.84 V.
    """
    clean = np.maximum(np.stack([waveform(), waveform(bottom=75.3)]), 0)
    tables = {
        (name, scale): echo_table.extract(detect_waveforms(result(scale * clean), name, 400, 3), saturation_level=level)
        for name, scale, level in (("pmt_log", 0.03, 0.9), ("pmt_log", 0.003, 0.9), ("pmt", 0.003, None))
    }
    strong, weak, linear = (table.sel(echo="bottom") for table in tables.values())
    for one, other, ratio in ((strong, weak, 10), (weak, linear, 1)):
        difference = one["energy"].mean("shot") - ratio * other["energy"].mean("shot")
        error = np.hypot(one["energy"].std("shot"), ratio * other["energy"].std("shot")) / np.sqrt(400)
        assert (abs(difference) < largest_z(400) * error).all()
        assert (error < 4e-3 * one["energy"].mean("shot")).all()
    for table in (strong, weak):
        for name in ("energy", "time_ns"):
            ratio = table[name].std("shot") / table[f"{name}_stderr"].mean("shot")
            assert np.abs(ratio - 1).max() < largest_z(400) / np.sqrt(2 * 400) + 0.05
        assert (table["flags"] & EchoFlag.SATURATED == 0).all()
    # 0.835 V is the strong record's highest sample.
    low = echo_table.extract(detect_waveforms(result(0.03 * clean), "pmt_log", 20, 3), saturation_level=0.8)
    assert (low["flags"].sel(echo="bottom") & EchoFlag.SATURATED).all()
    assert (low["flags"].sel(echo="surface") & EchoFlag.SATURATED == 0).all()


def test_a_single_record_behind_a_logarithm_is_expanded():
    """A record without the dimension shot, and without the mean that its deviation belongs to."""
    clean = np.maximum(np.stack([waveform()]), 0)
    shots = detect_waveforms(result(0.03 * clean), "pmt_log", 2, 3)
    both = echo_table.extract(shots)
    one = echo_table.extract(shots.isel(shot=0, drop=True).drop_vars("signal_mean"))
    # By the noise, of which the mean is free, 0.6 %; unexpanded, by factors.
    np.testing.assert_allclose(one["energy"], both["energy"].isel(shot=0), rtol=0.1)
    del shots.attrs["receiver.logarithm.volts_per_decade"]
    with pytest.raises(UserError, match=r"no attribute receiver.logarithm.volts_per_decade"):
        echo_table.extract(shots)


def test_correlated_noise_has_larger_errors():
    """Noise averaged over 4 bins has half the spread, and means of many bins have that of the noise before."""
    dataset = recorded(np.stack([waveform()]), 400, 0.0)
    white = 0.1 * np.random.default_rng(4).normal(size=(400, 1, BINS + 3))
    alike = np.lib.stride_tricks.sliding_window_view(white, 4, axis=2).mean(axis=-1)
    dataset["signal"] = dataset["signal"] + alike
    table = echo_table.extract(dataset)
    bottom = table.sel(echo="bottom")
    ratio = float(bottom["time_ns"].std() / bottom["time_ns_stderr"].mean())
    # 1.07 in the mean of many records; as if independent, it would be 1.6.
    assert abs(ratio - 1) < largest_z(400) / np.sqrt(2 * 400) + 0.08


def test_waveforms_in_the_noise_are_flagged():
    dataset = recorded(np.stack([waveform(), 0 * TIME]), 20, 0.05)
    table = echo_table.extract(dataset, ["gaussian", "peak", "deconvolution"])
    dark = table.isel(pixel=1)
    assert np.isnan(dark["time_ns"]).all()
    assert (dark["flags"] == EchoFlag.NO_ECHO).all()
    assert np.isfinite(table["time_ns"].isel(pixel=0).sel(echo="bottom")).all()


def test_saturated_echoes_are_flagged_by_mask_and_by_level():
    values = np.stack([waveform()] * 2)
    clipped = result(np.minimum(values, 8e-5))
    table = echo_table.extract(clipped, "peak", saturation_level=8e-5)
    assert (table["flags"].sel(echo="bottom") & EchoFlag.SATURATED).all()
    assert not (table["flags"].sel(echo="surface") & EchoFlag.SATURATED).any()
    dataset = recorded(values, 2, 0.01)
    mask = np.zeros(dataset["signal"].shape, dtype=bool)
    mask[1, 0, np.argmax(values[0])] = True
    table = echo_table.extract(dataset.assign(saturated=(dataset["signal"].dims, mask)))
    flagged = (table["flags"] & EchoFlag.SATURATED).astype(bool)
    assert flagged.sel(echo="bottom").values.tolist() == [[False, False], [True, False]]
    assert not flagged.sel(echo="surface").any()


def test_errors_of_saturated_echoes_hold():
    """Surface and bottom clipped at a tenth to a half of their height, with 1 % of noise of what is left.

    Their samples counted as if they were the echo: with the noise alone as error, arrivals were off by 10 of them.
    """
    rng = np.random.default_rng(11 + significance.seed_shift)
    power = echo(SURFACE, 3e-13) + echo(SURFACE + 25.0, 2e-13)
    for share in (0.1, 0.25, 0.5):
        level = share * power.max()
        noisy = np.minimum(power, level) + 0.01 * level * rng.standard_normal((40, power.size))
        dims = ("shot", "pixel", "time")
        signal = xr.DataArray(noisy[:, None], dims=dims, attrs={"units": "V"})
        saturated = xr.DataArray(np.broadcast_to(power >= level, (40, 1, power.size)), dims=dims)
        clear = recorded(power[None], 40, 0.01).assign(signal=signal, saturated=saturated)
        table = echo_table.extract(clear, noise=0.01 * level).isel(pixel=0)
        for name, true in (("surface", SURFACE), ("bottom", SURFACE + 25.0)):
            own = table.sel(echo=name)
            assert (own["flags"] & EchoFlag.SATURATED).all()
            error = own["time_ns"].values - true
            stated = own["time_ns_stderr"].values
            assert np.all(np.abs(error) < 2 * stated)
            assert np.all(stated < 0.6 * np.count_nonzero(power >= level) * (TIME[1] - TIME[0]))
            # Without what is clipped, the flanks give the time.
            assert np.abs(error.mean()) < 0.3


def test_spans_of_saturated_samples():
    """Runs that are an echo width apart count as one; a run counts for echoes within an echo width of it."""
    saturated = np.zeros((3, 60), dtype=bool)
    saturated[0, [10, 11, 12, 15, 16]] = saturated[1, [30, 40, 41]] = True
    bins = np.array([[11, 30, 20], [19, 41, -1], [40, 25, 59]])
    np.testing.assert_array_equal(saturated_spans(saturated, bins, 4.0), [[7, 1, 0], [7, 2, 0], [0, 0, 0]])


def test_a_bottom_nearer_than_a_pulse_is_flagged():
    values = np.stack([echo(SURFACE, 3e-13) + echo(SURFACE + delay, 3e-13) for delay in (3.2, 20.0)])
    flags = echo_table.extract(result(values))["flags"]
    merged = (flags & EchoFlag.MERGED).astype(bool).sel(echo=["surface", "bottom"])
    assert merged.values.tolist() == [[True, True], [False, False]]


def test_layers_of_the_water_are_found():
    """Half the backscatter from 3 m down."""
    step = 3.0 / PER_NS
    below = column(SURFACE + step, SURFACE + 70, -1.5e-5 * np.exp(-DECAY * step))
    table = echo_table.extract(result(np.stack([waveform(), waveform() + below])), layers=1)
    assert table["layer_p_value"].dims == ("pixel", "layer")
    assert float(table["layer_p_value"][0, 0]) > 0.01
    assert float(table["layer_p_value"][1, 0]) < 1e-6
    assert float(table["layer_depth_m"][1, 0]) == pytest.approx(3.0, abs=0.1)
    assert float(table["layer_step"][1, 0]) == pytest.approx(np.log(0.5), abs=0.07)


def test_the_pulse_may_be_given():
    """A ramp of 6 ns: centroid 2 ns before its end. Taken for a Gaussian, times would be that much early."""
    pulse = Pulse.sampled([0, 6, 6.01], [0, 1, 0])
    shares = np.diff(pulse.cumulative(EDGES - SURFACE - 0.2))
    values = (3e-13 / (DT * 1e-9) * shares)[np.newaxis]
    table = echo_table.extract(result(values), "centroid", pulse=pulse)
    assert float(table["time_ns"].sel(echo="surface")[0]) == pytest.approx(SURFACE + 0.2, abs=0.05)


@pytest.mark.slow
def test_csv_and_command(tmp_path):
    results.save(result(), tmp_path / "shot.nc")
    done = run("waveforms", tmp_path / "shot.nc", "--csv", tmp_path / "echoes.csv", "--layers", 1)
    assert done.exit_code == 0, done.output
    assert "attenuation of the column (1/m): median" in done.output
    assert done.output.count("bottom") == 4
    with (tmp_path / "echoes.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 16
    table = echo_table.extract(result())
    line = next(line for line in lines if line["pixel"] == "blue" and line["echo"] == "bottom")
    expected = table.sel(pixel="blue", echo="bottom")
    for name in ("time_ns", "depth_m", "energy", "time_ns_stderr", "attenuation"):
        assert float(line[name]) == pytest.approx(float(expected[name]), rel=1e-8, abs=0)
    missing = next(line for line in lines if line["echo"] == "target")
    assert (missing["time_ns"], missing["flags"]) == ("", "no_echo")
    table.to_netcdf(tmp_path / "table.nc", engine="h5netcdf")
    xr.testing.assert_equal(xr.load_dataset(tmp_path / "table.nc", engine="h5netcdf"), table)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--estimator", "best"], "estimator 'best' must be one of threshold, leading_edge"),
        (["--csv", "echoes.txt"], "--csv echoes.txt must end in .csv."),
        (["--no-table"], "--no-table leaves nothing to do"),
    ],
)
def test_invalid_options(tmp_path, options, sentence):
    results.save(result(), tmp_path / "shot.nc")
    assert_refused(run("waveforms", tmp_path / "shot.nc", *options), sentence)


def test_command_reads_what_a_receiver_recorded(tmp_path):
    """Shots hold a signal and no result's variables; other files are rejected."""
    shots = recorded(np.stack([waveform()]), 3, 0.01)
    shots.to_netcdf(tmp_path / "shots.nc", engine="h5netcdf")
    done = run("waveforms", tmp_path / "shots.nc", "--no-table", "--csv", tmp_path / "echoes.csv")
    assert done.exit_code == 0, done.output
    with (tmp_path / "echoes.csv").open() as file:
        found = [float(line["depth_m"]) for line in csv.DictReader(file) if line["echo"] == "bottom"]
    assert found == pytest.approx([70 * PER_NS] * 3, abs=0.05)
    shots.rename(signal="sound").to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    assert_refused(run("waveforms", tmp_path / "other.nc"), "is a NetCDF file, but not of mitransient-lidar")


def in_series(*shots):
    """Return results as a series with a truth of each shot."""
    joined = xr.concat(shots, "shot", combine_attrs="override").assign_coords(shot=np.arange(len(shots)))
    return joined.assign_coords(true_bottom_depth=("shot", 5.0 + np.arange(len(shots))))


def test_shots_of_a_series_have_their_own_errors(tmp_path):
    """Each shot of a series gives what it gives alone, whatever the errors of the others; the truth comes along."""
    shots = [result(np.stack([waveform(SURFACE + shift)] * 2)) for shift in (0.0, 1.5, -2.0)]
    for number, shot in enumerate(shots):
        shot["waveform_stderr"][:] = 10.0**-number * (1e-8 + 1e-3 * shot["waveform"])
    found = echo_table.extract(in_series(*shots))
    for number, shot in enumerate(shots):
        alone = echo_table.extract(shot)
        xr.testing.assert_allclose(found.isel(shot=number, drop=True), alone)
    errors = found["time_ns_stderr"].sel(echo="bottom").isel(pixel=0).values
    np.testing.assert_allclose(errors[:2] / errors[1:], 10, rtol=0.3)
    csv_tables.save_csv(found, tmp_path / "echoes.csv")
    with (tmp_path / "echoes.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert {(line["shot"], line["true_bottom_depth"]) for line in lines} == {("0", "5"), ("1", "6"), ("2", "7")}


@pytest.mark.slow
def test_records_of_a_series_have_true_errors():
    """Two shots of different strength and time, 200 records each: errors of both are those of their own noise."""
    powers = (np.maximum(waveform(), 0), 0.2 * np.maximum(waveform(SURFACE + 2), 0))
    places = in_series(*(result(np.stack([power] * 2)) for power in powers))
    shots = detect_waveforms(places, "apd", 200, 3, optical_density=1.9)
    bottoms = echo_table.extract(shots).sel(echo="bottom")
    for half in (slice(0, 200), slice(200, 400)):
        time, error = (bottoms[name].isel(shot=half).values.ravel() for name in ("time_ns", "time_ns_stderr"))
        # One electron's avalanche is the last peak of one in 3000 weak records, and some bottoms are not found.
        real = np.abs(time - np.nanmedian(time)) < 5
        assert np.count_nonzero(~real) <= largest_count(400, 2e-3)
        assert np.std(time[real]) / np.median(error[real]) == pytest.approx(
            1, abs=largest_z(400) / np.sqrt(2 * 400) + 0.07
        )
    errors = bottoms["time_ns_stderr"].values
    assert np.nanmedian(errors[200:]) > 2 * np.nanmedian(errors[:200])


def drop(name):
    shot = result()
    del shot.attrs[name]
    return shot


@pytest.mark.parametrize(
    ("dataset", "options", "sentence"),
    [
        (result().transpose("time", "pixel"), {}, r"waveform has the dimensions \('time', 'pixel'\)"),
        (result().drop_vars("pixel"), {}, "the dataset has no coordinate pixel"),
        (result().drop_vars("time"), {}, "the dataset has no coordinate time"),
        (result().drop_vars("waveform"), {}, "must have waveforms over time or signals of a receiver"),
        (drop("altitude"), {}, "the dataset has no attribute altitude"),
        (drop("pulse_fwhm_ns"), {}, "the dataset has no attribute pulse_fwhm_ns"),
        (result(np.full((1, BINS), np.nan)), {}, "waveform holds values that are not finite"),
        (result(), {"estimators": "best"}, "estimator 'best' must be one of"),
        (result(), {"estimators": []}, "estimator '' must be one of"),
        (result(), {"threshold": -1.0}, "threshold = -1 must be greater than 0"),
        (result(), {"layers": 20}, "layers = 20 must lie between 0 and 8"),
        (result(), {"block": 0}, "block = 0 must lie between 1"),
        (result(), {"depth_from": "top"}, "depth_from = 'top' must be 'echo' or 'mean'"),
        (result(), {"noise": [1.0, 2.0]}, r"noise of shape \(2,\) must be a number"),
        (recorded(np.stack([waveform()]), 2, 0.1).isel(time=slice(60, None)), {}, "at least 4 bins before"),
    ],
)
def test_invalid_input(dataset, options, sentence):
    with pytest.raises(UserError, match=sentence) as refused:
        echo_table.extract(dataset, **options)
    assert "\n" not in str(refused.value)
