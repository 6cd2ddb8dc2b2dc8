"""Stated errors of depths from records with jitter, in blocks, and of series behind a logarithm."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from lake_waveforms import PER_NS, SURFACE, column, echo, result
from significance import largest_z

from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS


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
