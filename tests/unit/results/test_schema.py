"""Kinds and ranges of attributes and arrays, checksums, two channels in one dataset, and errors of sums."""

import tracemalloc
from dataclasses import replace

import h5py
import numpy as np
import pytest
import xarray as xr
from rows import each_row, must_refuse
from scipy.stats import norm
from small_results import made
from synthetic_shots import ATTRIBUTES, SIGMA, SURFACE

from mitransient_lidar import results
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.column_fits import column_fit
from mitransient_lidar.analysis.waveforms.echo_detection import Records
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.rendering.accuracy import ErrorCorrelation
from mitransient_lidar.results.attributes import join, split
from mitransient_lidar.results.sum_errors import BlockCorrelation, SumErrors, with_correlation

GOOD = {
    "altitude": 200.0,
    "off_nadir_deg": 20,
    "refractive_index": 1.34,
    "error_median": float("nan"),
    "receiver_pose": [0.0] * 12,
    "field_of_view_sides_mrad": [],
    "error_inflation_bins": [1, 2],
    "error_inflation": [1.0, 1.5],
    "pixel_outlines": "[[[0, 1, 2, 3]], []]",
    "beam_outlines": '[{"share": 0.6, "lines": [[0, 1], []]}]',
    "target_outlines": '[{"id": "mine", "z": [-4, -3], "line": [0, 1]}]',
}


@pytest.fixture
def dataset():
    return made(np.ones((2, 5)), centres=[(1, 0), (-1, 0)], **GOOD)


def refusal(tmp_path, dataset):
    """Return the sentence of a file that is written by another program, and of the dataset itself."""
    path = tmp_path / "a.nc"
    dataset.to_netcdf(path, engine="h5netcdf")
    with pytest.raises(UserError) as caught:
        results.open(path)
    with pytest.raises(UserError) as direct:
        results.record_dims(dataset, "waveform")
    assert str(caught.value) == str(direct.value).replace("the dataset", str(path))
    return str(direct.value)


@each_row(
    ("altitude", "high", "a number between -1e+30 and 1e+06"),
    ("altitude", [1.0, 2.0], "a number between"),
    ("off_nadir_deg", np.inf, "a number between -360 and 180"),
    ("receiver_pose", [1.0] * 11, "12 finite numbers"),
    ("receiver_pose", [np.nan] * 12, "12 finite numbers"),
    ("error_inflation", [1.0, 2.0, 3.0], "2 numbers, as error_inflation_bins"),
    ("scene", 3, "a text"),
)
def test_attributes_of_another_kind_are_refused(name, value, allowed, tmp_path, dataset):
    told = refusal(tmp_path, dataset.assign_attrs({name: value}))
    assert f"the attribute {name} = " in told
    assert told.endswith(f"it must be {allowed}") or (allowed.endswith("between") and allowed in told)


@each_row(
    (lambda one: one.assign_coords(angle_x=("pixel", ["x", "y"])), "has angle_x with texts: it must hold numbers"),
    (lambda one: one.assign_coords(angle_y=("pixel", [np.inf, 0])), "has angle_y = inf: it must be finite"),
    (lambda one: one.assign_coords(angle_x=("other", [0.0, 1])), "has angle_x over (other), not over its pixels"),
    (lambda one: one.drop_vars("angle_y"), "has one of the coordinates angle_x and angle_y"),
    (lambda one: one.assign(waveform=one["waveform"].astype(str)), "has waveform with texts"),
    (lambda one: one.assign(waveform_stderr=one["waveform_stderr"][:, 0]), "has waveform_stderr over (pixel)"),
)
def test_arrays_of_another_kind_are_refused(change, message, tmp_path, dataset):
    assert message in refusal(tmp_path, change(dataset))


def test_a_damaged_file_is_refused_before_hdf5_reads_it(tmp_path, dataset):
    """A few bytes within its heaps can make HDF5 read for ever; and others change numbers without a word."""
    path = tmp_path / "a.nc"
    results.save(dataset, path)
    assert results.open(path).identical(dataset)
    whole = path.read_bytes()
    for place in (100, len(whole) // 2, len(whole) - 100):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        must_refuse(r"a\.nc is damaged or truncated: its SHA-256 is another one", results.open, path)


def test_files_that_other_programs_have_changed_are_read(tmp_path, dataset):
    path = tmp_path / "a.nc"
    results.save(dataset, path)
    assert xr.load_dataset(path, engine="h5netcdf", decode_times=False).sizes == dataset.sizes
    with h5py.File(path, "r+") as file:
        file.attrs["notes"] = "changed"
    assert results.open(path).attrs["notes"] == "changed"


def result(bins, wavelength):
    """A result of two pixels and so many bins."""
    attributes = {"wavelength_nm": wavelength, "passes": 3, "pulse_times_ns": [0.0, 1.0], "instrument": "eye"}
    return made(np.arange(2.0 * bins).reshape(2, bins), start=1000.0, names=["left", "right"], **attributes)


def test_both_channels_are_what_they_were(tmp_path):
    green, infrared = result(9, 532.0), result(20, 1064.0)
    both = join(green, infrared)
    assert both.sizes == {"pixel": 2, "time": 9, "infrared_pixel": 2, "infrared_time": 20}
    results.save(both, tmp_path / "both.nc")
    # Other programs see a group of its own.
    with xr.open_dataset(tmp_path / "both.nc", group="infrared", engine="h5netcdf") as group:
        assert group.attrs["wavelength_nm"] == 1064.0
        assert group["waveform"].shape == (2, 20)
    for dataset in (both, results.open(tmp_path / "both.nc")):
        for own, expected in zip(split(dataset), (green, infrared), strict=True):
            xr.testing.assert_identical(own, expected)
    must_refuse(r"an EXR file holds no infrared channel; use a .nc file", results.save, both, tmp_path / "both.exr")
    own, none = split(green)
    xr.testing.assert_identical(own, green)
    assert none is None
    # Waveforms alone, as a program takes from both.
    assert "infrared" not in split(both[["waveform"]])[0].attrs


def test_series_share_their_shots():
    """An interrupted infrared series once kept the number of green shots, and was not rendered again."""
    many = ((532.0, 4), (1064.0, 3))
    series = [xr.concat([result(9, nm)] * count, "shot").assign_attrs(shots=count) for nm, count in many]
    both = join(*series)
    assert [one.attrs["shots"] for one in (*split(both), *series)] == [3, 3, 4, 3]
    assert both["waveform"].sizes["shot"] == both["infrared_waveform"].sizes["shot"] == 3
    assert split(both)[1]["waveform"].dims == series[1]["waveform"].dims


def test_an_interruption_of_either_channel_is_one_of_both():
    whole, ended = (result(9, 532.0).assign_attrs(interrupted=number) for number in (0, 1))
    for channels, expected in (((whole, whole), 0), ((whole, ended), 1), ((ended, whole), 1)):
        assert join(*channels).attrs["interrupted"] == expected


@pytest.mark.parametrize("attribute", ["[]", "{"])
def test_another_attribute_is_refused(attribute):
    with pytest.raises(UserError, match="the attribute infrared"):
        split(join(result(9, 532.0), result(9, 1064.0)).assign_attrs(infrared=attribute))


def record(values, deviation, step=1.0, **attributes):
    """A result of one pixel with these values [W] and standard errors."""
    return made(values[None], deviation[None], start=1385.0, step=step, **{**ATTRIBUTES, **attributes})


@pytest.mark.parametrize("bins", [1000, 1027, 1100])
def test_bins_belong_to_their_block_at_the_end_of_a_record(bins):
    """Blocks of 2 or 3 bins, the last one shorter; all errors are shared, so that those of sums add up."""
    correlation, time = ErrorCorrelation(), 3e4 + 0.1 * np.arange(bins)
    passes = np.random.default_rng(3).normal(size=(20, 4, 1)) * np.ones(bins)
    for values in passes:
        correlation.add(values)
    middles, found = correlation.over(time)
    zero = xr.DataArray(np.ones((4, bins)), dims=("pixel", "time"))
    dataset = xr.Dataset({"waveform": zero, "waveform_stderr": zero}, {"time": time})
    one = with_correlation(dataset, middles, found)
    errors, joined = SumErrors.of(one), SumErrors.of(xr.concat([one, one], "shot"))
    np.testing.assert_allclose(joined.shared.correlation, errors.shared.correlation)
    np.testing.assert_array_equal(errors.shared.block, np.arange(bins) // -(-bins // 512))
    for count in range(2, 8):
        assert errors.of_sum(np.ones(count), np.ones(count), bins - count) == pytest.approx(count, rel=1e-5)
    # The same from sums over bins of their own, one of them moved to the end.
    places = np.stack([np.arange(bins - 6, bins), np.minimum(np.arange(bins - 3, bins + 3), bins - 1)])
    scaled = np.array([[1.0] * 6, [1.0] * 3 + [0.0] * 3])
    np.testing.assert_allclose(errors.shared.variances(scaled, places), [36, 9], rtol=1e-5)


def test_few_passes_make_no_errors_of_nearly_nothing():
    """The errors of neighbours of one pixel cancel by chance: means of 4 bins would have none, all bins be echoes."""
    time, deviation = 1385.5 + np.arange(400), 1e-9 * np.ones(400)
    cancel = (-1.0) ** np.add.outer(np.arange(400), np.arange(400))
    values = 2e-6 * norm.pdf(time, SURFACE, SIGMA) + 1e-7 * np.exp(-0.03 * (time - SURFACE)) * (time > SURFACE)
    for passes, least in ((4, 1.0), (100, 0.1)):
        dataset = with_correlation(record(values, deviation, passes=passes), time, cancel)
        found = Waveforms.from_dataset(dataset, None, None, None, None)
        np.testing.assert_allclose(found.noise, least * 1e-9, rtol=1e-6)
    shared = BlockCorrelation(2 * np.eye(400) - 1, np.arange(400))
    records = replace(Records.of(values[np.newaxis], time, 1e-9), shared=shared)
    fit = column_fit(records, [SURFACE + 10], [SURFACE + 60], [SURFACE])
    assert np.isfinite([fit.level, fit.decay, fit.correlation]).all()


def test_a_record_of_very_many_bins_needs_little_memory():
    """200 000 bins, whose correlations would be 320 GB."""
    bins, step = 200_000, 0.5
    time, blocks = 1385 + step * (np.arange(bins) + 0.5), np.arange(0, bins, 391)
    values = 2e-4 * norm.pdf(time, SURFACE, SIGMA) + 1e-4 * norm.pdf(time, SURFACE + 70, SIGMA)
    correlation = 0.9 ** np.abs(np.subtract.outer(*2 * [np.arange(blocks.size)]))
    middles = np.add.reduceat(time, blocks) / np.diff(np.append(blocks, bins))
    tracemalloc.start()
    dataset = with_correlation(record(values, 1e-2 * values + 1e-9, step, passes=20), middles, correlation)
    table = echo_table.extract(dataset)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.2e9
    np.testing.assert_allclose(table["time_ns"].sel(echo="bottom"), SURFACE + 70, atol=0.05)


def test_correlations_of_another_kind_are_refused():
    middles = 1385.0 + np.arange(20)
    one = with_correlation(record(np.ones(60), np.ones(60)), middles, np.eye(20))
    for damaged, message in (
        (one.rename(other_error_time="other"), r"over \{'error_time': 20, 'other': 20\}: it must be square"),
        (one.isel(error_time=slice(0)), "'error_time': 0.*it must be square"),
        (one.isel(other_error_time=[0, 1]), "'other_error_time': 2.*it must be square"),
        (one.assign(error_correlation=one["error_correlation"] * np.nan), "error_correlation that is not of finite"),
        (one.assign_coords(error_time=["x"] * 20), "error_time that is not of finite numbers"),
        (one.drop_vars("time").assign_coords(time=60 * ["x"]), "result has time that is not of finite numbers"),
    ):
        with pytest.raises(UserError, match=message):
            SumErrors.of(damaged)
