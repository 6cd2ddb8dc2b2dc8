"""Errors of echoes and depths behind a receiver, against the scatter of shots."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import significance
import xarray as xr
from lake_waveforms import BINS, PER_NS, SURFACE, TIME, column, echo, in_series, recorded, result, waveform
from significance import largest_count, largest_z

from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms import csv_tables, echo_table
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS


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
    """Surface and bottom clipped at a tenth to a half of their height, with 1 % of noise of what is left."""
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


def lake(bottom_ns, level=0.0):
    """A surface echo and a bottom echo of a level lake at nadir, and a column of a power [W] at the surface."""
    power = echo(SURFACE, 3e-13) + column(SURFACE, SURFACE + bottom_ns, level) + echo(SURFACE + bottom_ns, 6e-13)
    return result(np.maximum(power, 0)[np.newaxis])


def depths(chain, depth_from):
    record = detect_waveforms(lake(60.0), chain, shots=400, seed=2)
    found = echo_table.extract(record, "gaussian", depth_from=depth_from).sel(echo="bottom").squeeze("pixel")
    return found["depth_m"].values, found["depth_m_stderr"].values


@pytest.mark.parametrize(("name", "density", "share"), [("apd", 1.9, 0.03), ("pmt_log", 1.1, 0.5)])
def test_blocks_and_series_have_the_errors_of_whole_records(name, density, share):
    """200 records of two shots: depths in blocks are those of whole records, errors of both those of their noise."""
    chain = RECEIVERS[name]
    places = xr.concat([lake(60.0, 1.5e-5)] * 2, "shot", combine_attrs="override").assign_coords(shot=[0, 1])
    light = {"shots": 200, "seed": 3, "optical_density": density}
    whole = detect_waveforms(places, chain, **light)
    mean = whole["signal_mean"]
    kept = {"block_threshold_v": share * float(mean.max() - mean.min()), "block_before": 6, "block_after": 8}
    blocks = detect_waveforms(places, replace(chain, digitiser=replace(chain.digitiser, **kept)), **light)
    missing = blocks["signal"].isnull()
    assert 0.4 < float(missing.mean()) < 0.6
    found = {record: echo_table.extract(one).sel(echo="bottom") for record, one in enumerate((whole, blocks))}
    stated = float(found[0]["depth_m_stderr"].median())
    assert np.sqrt(np.mean((found[1]["depth_m"] - found[0]["depth_m"]).values ** 2)) < 0.3 * stated
    for echoes in found.values():
        spread = echoes["depth_m"].std("shot").values / echoes["depth_m_stderr"].median("shot").values
        assert spread == pytest.approx(1, abs=largest_z(400) / np.sqrt(2 * 400) + 0.1)
    with pytest.raises(UserError, match="dark_level and block_level must have a finite number for each pixel"):
        echo_table.extract(blocks.assign(block_level=blocks["dark_level"]))


@pytest.mark.parametrize(("until", "hidden"), [(20.0, False), (45.0, True)])
def test_a_bottom_behind_a_clipped_one_may_be_its_second_return(until, hidden):
    """A bottom 60 ns behind the surface is light returned twice where another one 30 ns behind it may be clipped."""
    record = lake(60.0)
    level = 1.1 * float(record["waveform"].where(record["time"] > SURFACE + 50).max())
    behind = record["time"] - SURFACE
    # The falling edge of the last clipped echo.
    edge = level * np.exp(-0.5 * np.maximum(behind - until, 0) ** 2 / 2**2)
    record["waveform"] = np.maximum(record["waveform"], edge.where(behind > -5, 0.0)).clip(max=level)
    settings = {"saturation_level": level, "noise": 1e-3 * level, "depth_from": "mean"}
    bottom = echo_table.extract(record, **settings).sel(echo="bottom").squeeze("pixel")
    assert float(bottom["depth_m"]) == pytest.approx(60 * PER_NS, abs=0.1)
    assert bool(bottom["flags"] & EchoFlag.SATURATED) == hidden
    assert (float(bottom["depth_m_stderr"]) == pytest.approx(30 * PER_NS, rel=0.05)) == hidden
