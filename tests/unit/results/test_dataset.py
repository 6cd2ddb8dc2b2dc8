"""Datasets: labels, attributes, and round trips through both file formats."""

import logging
import os

import numpy as np
import pytest
import xarray as xr
from rows import each_row, must_refuse
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results import exr

ATTRIBUTES = {
    "scene": "fig09",
    "seed": 2**40 + 1,
    "scene.wind_speed": 3.0,
    "error_median": 0.1,  # not representable in 32 bits
    "layout": "2x2",
    "notes": "Östersjön, 深さ",
    "empty": "",
    "nothing": [],
    "one_int": [7],
    "one_text": ["å"],
    "floats": [0.1, 1e-300],
    "channels": "a name that OpenEXR reserves",
    "unknown": float("nan"),
}


def make(pixels=4, bins=6, grid=None, names=None, attributes=ATTRIBUTES):
    rng = np.random.default_rng(3)
    values = [1e-15 * rng.random((pixels, bins)) for _ in range(2)] + [1e-6 * rng.random((pixels, bins)) for _ in "ab"]
    return results.build(
        *values,
        time=TimeAxis(1400.1, 0.3, bins),
        pixel_names=names or [f"p{i}" for i in range(pixels)],
        # In the order of a picture: far to near, left to right.
        pixel_centres_mrad=-np.sort(-rng.normal(size=(pixels, 2)), axis=0),
        grid=grid,
        attributes=attributes,
    )


def assert_same_kinds(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert type(other[name]) is type(value), name
        if isinstance(value, list):
            assert [type(item) for item in other[name]] == [type(item) for item in value], name


def test_build_labels_time_at_bin_centres():
    dataset = make()
    # Left edges would give 1400.1 and 1400.4.
    np.testing.assert_allclose(dataset["time"].values[:2], [1400.25, 1400.55], rtol=0, atol=1e-9)
    units = [dataset[name].attrs["units"] for name in ("time", "waveform", "impulse_response")]
    assert units == ["ns", "W", "J"]
    assert dataset["waveform"].dims == ("pixel", "time")
    assert dataset["waveform"].attrs["ancillary_variables"] == "waveform_stderr"
    assert (dataset.attrs["Conventions"], dataset.attrs["scene.wind_speed"]) == ("CF-1.11", 3.0)


def test_build_orders_an_imager_row_by_row():
    centres = [(angle_x, angle_y) for angle_x in (5.0, -5.0) for angle_y in (9.0, 0.0, -9.0)]
    dataset = made(np.arange(12.0).reshape(6, 2), centres=centres, grid=(2, 3))
    assert dataset["waveform"].dims == ("row", "column", "time")
    assert dataset["waveform"].values[1, 0].tolist() == [6.0, 7.0]
    assert dataset["angle_x"].values[0].tolist() == [5.0, 5.0, 5.0]
    assert dataset["angle_y"].values[1].tolist() == [9.0, 0.0, -9.0]
    assert "pixel" not in dataset.coords


@each_row(
    ({"time": TimeAxis(0.0, 0.0, 3)}, "bin_width_ns = 0 must be greater than 0"),
    ({"time": TimeAxis(float("inf"), 1.0, 3)}, "time_start_ns = inf must be finite"),
    ({"pixel_names": ["a", "a"]}, "must be 2 different names"),
    ({"attributes": {"bad": None}}, "attribute bad = None"),
    ({"attributes": {"bad": ["a", 1]}}, "attribute bad"),
    ({"attributes": {"bad": 2**63}}, "attribute bad"),
)
def test_build_rejects(change, sentence):
    arguments = {"time": TimeAxis(0.0, 1.0, 3), "pixel_names": ["a", "b"]}
    arguments |= {"pixel_centres_mrad": np.zeros((2, 2)), "attributes": {}} | change
    with pytest.raises(ValueError, match=sentence):
        results.build(*[np.ones((2, 3))] * 4, **arguments)


def test_build_warns_of_non_finite_values_and_keeps_them(caplog):
    waveform = np.ones((3, 4))
    waveform[1, :2], waveform[2, 3] = np.nan, np.inf
    with caplog.at_level(logging.WARNING):
        dataset = made(waveform, names=["red", "green", "blue"])
    assert "waveform has non-finite values in pixel green: 2, blue: 1" in caplog.messages
    assert np.isnan(dataset["waveform"].values[1, 0])


CASES = {
    "four pixels": {},
    "one pixel, one bin": {"pixels": 1, "bins": 1},
    "odd names": {"names": ["", "a.b/c", 'ö "x" \n', "日本"]},
    "imager": {"pixels": 6, "grid": (2, 3)},
    "imager of one pixel": {"pixels": 1, "grid": (1, 1)},
    "one column": {"pixels": 3, "grid": (3, 1)},
}


@pytest.mark.parametrize("suffix", [".exr", ".nc"])
@pytest.mark.parametrize("case", CASES)
def test_round_trip(tmp_path, case, suffix):
    dataset = make(**CASES[case])
    kept = dataset.copy(deep=True)
    path = tmp_path / f"result{suffix}"
    results.save(dataset, path)
    xr.testing.assert_identical(dataset, kept)  # saving does not change the dataset
    back = results.open(path)
    if suffix == ".nc":
        xr.testing.assert_identical(back, dataset)
    else:
        for name in dataset.data_vars:
            assert back[name].dtype == np.float64
            np.testing.assert_array_equal(back[name].values, dataset[name].values.astype(np.float32))
        nothing = [str(name) for name in dataset.data_vars]
        xr.testing.assert_identical(back.drop_vars(nothing), dataset.drop_vars(nothing))
        assert {name: back[name].attrs for name in nothing} == {name: dataset[name].attrs for name in nothing}
    assert_same_kinds(dataset.attrs, back.attrs)
    for name in dataset.coords:
        assert back[name].dtype.kind == dataset[name].dtype.kind
        assert_same_kinds(dataset[name].attrs, back[name].attrs)
    assert list(tmp_path.iterdir()) == [path]


@each_row(".exr", ".nc")
def test_files_of_any_name_keep_values_that_are_not_finite_and_other_programs_read_netcdf(suffix, tmp_path):
    dataset = make()
    dataset["waveform"][0, 0], dataset["waveform"][1, 1] = np.nan, -np.inf
    results.save(dataset, tmp_path / f"a{suffix}")
    os.rename(tmp_path / f"a{suffix}", tmp_path / "a.dat")
    back = results.open(tmp_path / "a.dat")
    np.testing.assert_allclose(back["waveform"], dataset["waveform"], rtol=1e-6)
    assert back.attrs["scene"] == "fig09"
    if suffix == ".nc":
        with xr.open_dataset(tmp_path / "a.dat", engine="h5netcdf") as other:
            # Decoded as a time span, ns would become integers.
            assert other["time"].dtype == np.float64
            np.testing.assert_array_equal(other["time"].values, dataset["time"].values)
            assert "_FillValue" not in other["time"].encoding
            assert other.attrs["scene.wind_speed"] == 3.0


def test_a_file_has_at_most_forty_attributes_and_gives_all_back(tmp_path):
    many = make(attributes={**ATTRIBUTES, "scene_xml": "<scene/>", **{f"scene.parameter_{i}": i for i in range(90)}})
    for suffix in (".nc", ".exr"):
        results.save(many, tmp_path / f"a{suffix}")
        back = results.open(tmp_path / f"a{suffix}")
        assert_same_kinds(many.attrs, back.attrs)
        xr.testing.assert_identical(back.drop_vars(back.data_vars), many.drop_vars(many.data_vars))
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as other:
        assert len(other.attrs) <= 40
        assert {"title", "history", "scene", "seed", "error_median", "scene_xml"} < set(other.attrs)


def test_images_of_many_bins_have_several_parts(tmp_path):
    """OpenImageIO opens no part of more than 1024 channels, and 8000 bins in one took OpenEXR 2 s."""
    dataset = make(pixels=2, bins=500)
    results.save(dataset, tmp_path / "a.exr")
    back = results.open(tmp_path / "a.exr")["waveform_stderr"]
    np.testing.assert_array_equal(back, dataset["waveform_stderr"].astype(np.float32))
    parts = exr.read_parts(tmp_path / "a.exr")
    assert {part.name: len(part.channels) for part in parts} == {"bin0000.Y": 1024, "wave0012.Y": 976}
    # A file without its middle is not taken for a shorter record.
    own = {"mitransientLidar": parts[0].attributes["mitransientLidar"]}
    kept = {name: image for name, image in parts[1].channels.items() if not name.startswith("wave0100")}
    exr.write(tmp_path / "b.exr", [parts[0]._replace(attributes=own), parts[1]._replace(attributes={}, channels=kept)])
    must_refuse("damaged", results.open, tmp_path / "b.exr")


@pytest.mark.parametrize("suffix", [".exr", ".nc"])
def test_failed_save_leaves_no_file(tmp_path, suffix):
    (tmp_path / "file").write_text("regular")
    with pytest.raises(UserError, match=rf"cannot write .*file/a{suffix}: .*Not a directory"):
        results.save(make(), tmp_path / "file" / f"a{suffix}")
    must_refuse(r"cannot write .*missing/a", results.save, make(), tmp_path / "missing" / f"a{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    must_refuse(r"cannot write .*: Is a directory", results.save, make(), tmp_path / f"folder{suffix}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", f"folder{suffix}"]


def test_time_axis_from_attributes_or_from_the_coordinate():
    dataset = make(bins=6)
    assert results.time_axis(dataset) == TimeAxis(1400.1, 0.3, 6)
    # After a selection the attributes belong to other bins.
    later = results.time_axis(dataset.isel(time=slice(2, 5)))
    assert (later.start_ns, later.bin_width_ns, later.bin_count) == (pytest.approx(1400.7), pytest.approx(0.3), 3)
    coarse = results.time_axis(dataset.coarsen(time=2).mean())
    assert (coarse.start_ns, coarse.bin_width_ns, coarse.bin_count) == (pytest.approx(1400.1), pytest.approx(0.6), 3)
    one = dataset.isel(time=[3])
    assert results.time_axis(one).start_ns == pytest.approx(1401.0)
    for invalid in (one.assign_attrs(bin_width_ns="wide"), dataset.assign_coords(time=dataset["time"][::-1].values)):
        must_refuse(r"no attribute bin_width_ns|no two increasing times", results.time_axis, invalid)
    must_refuse("no coordinate time", results.time_axis, dataset.drop_vars("time"))
