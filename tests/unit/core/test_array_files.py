"""Arrays from files; damaged files are covered by the tests of height maps."""

import numpy as np
import OpenEXR
import pytest
import xarray as xr

from mitransient_lidar.core.array_files import read_exr, read_netcdf, read_npy, read_npz, readable_suffix
from mitransient_lidar.core.errors import UserError

VALUES = np.arange(12.0).reshape(3, 4)


def test_numpy_files(tmp_path):
    np.save(tmp_path / "a.npy", VALUES)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), VALUES)
    np.savez(tmp_path / "a.npz", a=VALUES, b=VALUES[0], other=np.array([None]))
    arrays = read_npz(tmp_path / "a.npz", ("a", "b", "missing"))
    assert list(arrays) == ["a", "b"]
    np.testing.assert_array_equal(arrays["b"], VALUES[0])
    with pytest.raises(UserError, match=r"a.npz is damaged, or is not an archive"):
        read_npz(tmp_path / "a.npz", ("other",))


def test_exr_channels_have_the_top_row_first(tmp_path):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": VALUES.astype(np.float32), "Z": np.zeros((3, 4), np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    channels = read_exr(tmp_path / "a.exr")
    assert sorted(channels) == ["Y", "Z"]
    np.testing.assert_array_equal(channels["Y"], VALUES)


def test_netcdf_variables(tmp_path):
    dataset = xr.Dataset({"a": (("y", "x"), VALUES), "b": ((), 2.0)}, coords={"x": np.arange(4)})
    dataset.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    variables = read_netcdf(tmp_path / "a.nc")
    assert {name: (v.dims, v.is_coordinate) for name, v in variables.items()} == {
        "a": (("y", "x"), False),
        "b": ((), False),
        "x": (("x",), True),
    }
    np.testing.assert_array_equal(variables["a"].values, VALUES)


def test_suffixes(tmp_path):
    (tmp_path / "A.NPY").touch()
    assert readable_suffix(tmp_path / "A.NPY", (".npy", ".npz"), "map") == ".npy"
    with pytest.raises(UserError, match=r"a.tif: the name of a map must end in .npy, .npz\."):
        readable_suffix(tmp_path / "a.tif", (".npy", ".npz"), "map")
    with pytest.raises(UserError, match=r"cannot read .*b.npy: No such file or directory"):
        readable_suffix(tmp_path / "b.npy", (".npy", ".npz"), "map")
