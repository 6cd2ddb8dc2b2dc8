"""Tables of echoes: dimensions, units, flags, layers, files, the command, and input that is refused."""

import csv

import numpy as np
import pytest
import xarray as xr
from command_line import assert_refused, run
from lake_waveforms import BINS, DECAY, PER_NS, SHIFTS, SURFACE, TIME, column, echo, lit, recorded, result, waveform
from rows import each_row, refuses

from mitransient_lidar import results
from mitransient_lidar.analysis.waveforms import csv_tables, echo_table
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag

#: Delays of targets behind the surface [ns], of four waveforms.
PLACES = [[], [40], [40, 28], [44, 34, 54]]


@each_row(*echo_table.ESTIMATORS)
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


def test_shots_together_have_the_echoes_of_each_alone():
    random = np.random.default_rng(3)
    shots = [result(np.stack([waveform(SURFACE + shift) for shift in SHIFTS + late])) for late in (0.0, 0.4, 1.1)]
    for shot in shots:
        shot["waveform_stderr"] = 1e-6 + 0 * shot["waveform"]
        shot["waveform"] = shot["waveform"] + 1e-6 * np.abs(random.standard_normal(shot["waveform"].shape))
    together = echo_table.extract(xr.concat(shots, "shot").assign_coords(shot=range(3)), targets=1)
    for number, shot in enumerate(shots):
        alone = echo_table.extract(shot, targets=1)
        for name, values in alone.data_vars.items():
            np.testing.assert_allclose(together[name].isel(shot=number), values, rtol=1e-9, err_msg=name)


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
    # In blocks with different numbers of targets, too.
    blocks = echo_table.extract(result(np.stack(shots)), block=1)
    xr.testing.assert_identical(*(one.assign_attrs(history="") for one in (blocks, table)))  # without their times


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


def test_rows_say_why_a_depth_is_unknown():
    dark = 0 * TIME
    surface_only = echo(SURFACE, 3e-13)
    dataset = lit(result(np.stack([waveform(), dark, surface_only])), [0.4, 0.3, 0.3])
    cells = csv_tables.echo_frame(echo_table.extract(dataset)).to_dict("records")
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


@pytest.mark.slow
def test_csv_and_command(tmp_path):
    results.save(result(), tmp_path / "shot.nc")
    done = run("echoes", tmp_path / "shot.nc", "--csv", tmp_path / "echoes.csv", "--layers", 1)
    assert done.exit_code == 0, done.output
    assert "attenuation of the column (1/m): median" in done.output
    assert sum(line.split()[1:2] == ["bottom"] for line in done.output.splitlines()) == 4
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


@each_row(
    (["--estimator", "best"], "estimator 'best' must be one of threshold, leading_edge"),
    (["--csv", "echoes.txt"], "--csv echoes.txt must end in .csv"),
    (["--no-table"], "--no-table leaves nothing to do"),
)
def test_invalid_options(options, sentence, tmp_path):
    results.save(result(), tmp_path / "shot.nc")
    assert_refused(run("echoes", tmp_path / "shot.nc", *options), sentence)


def drop(name):
    shot = result()
    del shot.attrs[name]
    return shot


@refuses(
    (result().transpose("time", "pixel"), {}, r"waveform has the dimensions \('time', 'pixel'\)"),
    (result().drop_vars("pixel"), {}, "the dataset has no coordinate pixel"),
    (result().drop_vars("time"), {}, "the dataset has no coordinate time"),
    (result().drop_vars("waveform"), {}, "must have waveforms over time or signals of a receiver"),
    (drop("altitude"), {}, "the dataset has no attribute altitude"),
    (drop("pulse_fwhm_ns"), {}, "the dataset has no attribute pulse_fwhm_ns"),
    *(
        (result(**{name: np.nan}), {}, f"the attribute {name} = nan of the dataset must be a number")
        for name in ("divergence_mrad", "field_of_view_mrad", "response_time_ns", "wavelength_nm")
    ),
    (result(np.full((1, BINS), np.nan)), {}, "waveform holds values that are not finite"),
    (result(), {"estimators": "best"}, "estimator 'best' must be one of"),
    (result(), {"estimators": []}, "estimator '' must be one of"),
    (result(), {"threshold": -1.0}, "threshold = -1 must be greater than 0"),
    (result(), {"layers": 20}, "layers = 20 must lie between 0 and 8"),
    (result(), {"block": 0}, "block = 0 must lie between 1"),
    (result(), {"depth_from": "top"}, "depth_from = 'top' must be 'echo' or 'mean'"),
    (result(), {"noise": [1.0, 2.0]}, r"noise of shape \(2,\) must be a number"),
    (recorded(np.stack([waveform()]), 2, 0.1).isel(time=slice(60, None)), {}, "at least 4 bins before"),
)
def test_invalid_input(dataset, options):
    echo_table.extract(dataset, **options)
