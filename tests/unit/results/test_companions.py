"""Results of two channels in one dataset and one file."""

import numpy as np
import pytest
import xarray as xr
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.results.attributes import join, split


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
    with pytest.raises(UserError, match=r"an EXR file holds no infrared channel; use a .nc file"):
        results.save(both, tmp_path / "both.exr")
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
