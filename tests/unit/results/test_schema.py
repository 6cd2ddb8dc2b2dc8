"""Kinds and ranges of attributes and arrays, checksums, and two channels in one dataset."""

import h5py
import numpy as np
import pytest
import xarray as xr
from rows import each_row, must_refuse
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.results.attributes import join, split

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
    series = [xr.concat([result(9, nm)] * count, "shot") for nm, count in ((532.0, 4), (1064.0, 3))]
    both = join(*series)
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
