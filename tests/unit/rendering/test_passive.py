"""Pictures by daylight as their user makes them: what is returned, files, frames, the command, and mistakes."""

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
import xarray as xr
from rows import must_refuse, refuses
from significance import largest_z

import mitransient_lidar
from mitransient_lidar.rendering import passive
from mitransient_lidar.results import save
from mitransient_lidar.transport.daylight.renderer import DaylightLight, pixel_solid_angles
from mitransient_lidar.transport.scene_parts import find_lidar_scene
from mitransient_lidar.transport.sensor.pixels import HexPixels, LayoutPixels

PASSIVE = {"type": "passive_volpath", "paths_per_pass": 4096}


def scene(layout="4x4", **parts):
    return {
        "integrator": PASSIVE,
        "rx": {
            "type": "multipixel_receiver",
            "layout": layout,
            "imager": True if layout == "4x4" else None,
            "film": {"type": "time_gated_film"},
        },
        "sea": {"type": "ocean_surface", "wind_speed": 4.0, "refined_size": 12.0, "cell_size": 0.5,
                "shortest_wave": 1.0, "interior": {"type": "layered_water"}},
        "bottom": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -8]).scale(500),
            "bsdf": {"type": "diffuse"},
        },
        "sun": {"type": "sun", "zenith_deg": 50.0, "azimuth_deg": 90.0},
        "sky": {"type": "sky", "sun_zenith_deg": 50.0, "sun_azimuth_deg": 90.0},
        **parts,
    }  # fmt: skip


def no_none(parts):
    return {
        key: no_none(value) if isinstance(value, dict) else value for key, value in parts.items() if value is not None
    }


def render(parts=None, **options):
    options.setdefault("passes", 2)
    return passive.render_passive(no_none(parts or scene()), **options)


def test_ratio_statistics():
    """Against the spread of many repeats: ratios of sums of correlated numbers."""
    rng = np.random.default_rng(3)
    ratios, errors = [], []
    for _ in range(400):
        statistics = passive.RatioStatistics(1)
        for _ in range(24):
            sampled = rng.uniform(0.5, 1.5, 1)
            statistics.add(sampled * 3 + rng.normal(0, 0.4, 1), sampled)
        ratios.append(statistics.ratio[0])
        errors.append(statistics.stderr[0])
    assert abs(np.mean(ratios) - 3) < largest_z(400) * np.std(ratios) / 20
    # The spread of 400 ratios has an error of 1/sqrt(800).
    assert abs(np.mean(errors) / np.std(ratios, ddof=1) - 1) < 0.02 + largest_z(10**6) / np.sqrt(800)
    nothing = passive.RatioStatistics(2)
    for _ in range(2):
        nothing.add(np.array([1.0, 0.0]), np.array([1.0, 0.0]))
    assert np.isnan(nothing.ratio[1])
    assert nothing.relative_errors() == pytest.approx([0.0])


@pytest.mark.slow
def test_smoothed_images_are_those_of_other_passes_with_less_noise():
    """In a circular field of view over a level bottom, where smoothing changes little."""
    parts = {**scene("24x24"), "integrator": {**PASSIVE, "paths_per_pass": 2**14}}
    sharp, smooth = (render(parts, passes=12, seed=seed, smooth=sigma) for seed, sigma in ((1, None), (2, 2.0)))
    errors = np.hypot(sharp["radiance_stderr"], smooth["radiance_stderr"]).values
    z = (smooth["radiance"] - sharp["radiance"]).values / errors
    lit = np.isfinite(z)
    assert lit.sum() > 400
    assert 0.9 < np.sqrt(np.mean(z[lit] ** 2)) < 1.3  # errors of twelve passes, some of them bright
    # Smoothing moves light between pixels: their sum has the error of sharp ones.
    sums = [one["radiance"].values[lit].sum() for one in (sharp, smooth)]
    assert abs(sums[1] - sums[0]) < 4.5 * np.sqrt(2 * (sharp["radiance_stderr"].values[lit] ** 2).sum())
    variance = [float((one["radiance_stderr"] ** 2).mean()) for one in (sharp, smooth)]
    assert variance[1] < 0.4 * variance[0]
    assert smooth.attrs["smooth_pixels"] == 2.0
    assert 0 <= smooth.attrs["smoothing_bias"] < 0.05
    again = mitransient_lidar.render(smooth, passes=2)
    assert again.attrs["smooth_pixels"] == 2.0
    must_refuse("smooth = 1 pixels needs a layout of rows and columns", lambda: render(scene("hex7"), smooth=1.0))


@pytest.mark.slow
def test_non_finite_radiance_is_kept_and_reported(monkeypatch, caplog):
    """One pixel of sixteen receives a value that is not finite."""
    original = DaylightLight.add

    def add(self, path, found, active):
        original(self, path, dr.select(path.pixel == 5, dr.nan, found), active)

    monkeypatch.setattr(DaylightLight, "add", add)
    picture = render()
    assert np.flatnonzero(~np.isfinite(picture["radiance"].values)).tolist() == [5]
    assert "1 of 16 pixels have non-finite radiance" in caplog.text


def test_solid_angles():
    """Of layouts exactly: (1 + g^2)^(-3/2) over the cells; hexagons fill 82.7 % of the circle."""
    square = pixel_solid_angles(LayoutPixels("3x5", 0.6, "square"))
    inside = 4 * np.arcsin(np.sin(np.arctan(0.3)) ** 2)
    assert square.sum() == pytest.approx(inside, rel=1e-5)
    assert square[0] == pytest.approx(square[-1], rel=1e-5)
    circle = pixel_solid_angles(LayoutPixels("2x2", 0.03, "circle"))
    np.testing.assert_allclose(circle, np.pi * 0.015**2 / 4, rtol=1e-3)
    pixels = HexPixels("hex7", 0.03, 1.0)
    np.testing.assert_allclose(pixel_solid_angles(pixels), pixels.area / 7, rtol=2e-3)


@pytest.mark.slow
def test_a_still_picture():
    picture = render(filter_width_nm=2.0, passes=4)
    assert picture["radiance"].dims == ("row", "column")
    assert picture["radiance"].attrs["units"] == "W m-2 sr-1 nm-1"
    assert float(picture["radiance"].min()) > 0
    # 0.025 m^2 of aperture, optics 0.9, air 0.9 both ways; the circle cuts the corners' cells.
    etendue = 0.025 * 0.9 * np.sqrt(0.9) * np.pi * 0.015**2
    assert float(picture["etendue"].sum()) == pytest.approx(etendue, rel=1e-3)
    power = picture["radiance"] * picture["etendue"] * 2.0
    np.testing.assert_allclose(picture["background_power"], power)
    mean = float((picture["radiance"] * picture["etendue"]).sum() / picture["etendue"].sum())
    assert picture.attrs["background_radiance"] == pytest.approx(mean)
    assert {"sun_zenith_deg", "sky_irradiance", "passes", "seed", "integrator", "title"} <= set(picture.attrs)


@pytest.mark.slow
def test_frames_move_the_sea_and_fill_files(tmp_path):
    pictures = render(frames=2, frame_step_s=0.5, filter_width_nm=1.0)
    assert pictures["radiance"].dims == ("frame", "row", "column")
    assert pictures["time_s"].values.tolist() == [0.0, 0.5]
    assert np.any(pictures["radiance"][0] != pictures["radiance"][1])
    for suffix in (".nc", ".exr"):
        save(pictures, tmp_path / f"a{suffix}")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as again:
        np.testing.assert_array_equal(again["radiance"], pictures["radiance"])
        np.testing.assert_array_equal(again["background_power"], pictures["background_power"])
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert [part.header["name"] for part in file.parts] == ["frame0000", "frame0001"]
        assert set(file.parts[1].channels) == {"Y", "Y.stderr"}
        np.testing.assert_array_equal(file.parts[1].channels["Y"].pixels, pictures["radiance"][1].astype(np.float32))
    save(pictures.isel(frame=0), tmp_path / "b.exr")
    with OpenEXR.File(str(tmp_path / "b.exr"), separate_channels=True) as file:
        assert len(file.parts) == 1
    must_refuse(r"must end in \.exr, \.nc", save, pictures, tmp_path / "a.txt")
    # A flat sea has nothing that moves: frames differ by noise only.
    flat = no_none(scene())
    flat["sea"]["spectrum"] = "flat"
    still = render(flat, frames=2, passes=16)
    z = (still["radiance"][0] - still["radiance"][1]) / np.hypot(*still["radiance_stderr"].values)
    assert np.abs(z).max() < largest_z(16, 16)


@pytest.mark.slow
def test_daylight_does_not_touch_the_laser():
    """The lidar integrators render a scene with sun and sky as they do without."""
    laser = {"tx": {"type": "lidar_transmitter"}, "integrator": {"type": "lidar_volpath", "paths_per_pass": 4096}}
    day = scene("2x2", **laser)
    night = {name: part for name, part in day.items() if name not in ("sun", "sky")}
    first, second = (mitransient_lidar.render(no_none(parts), passes=2)["impulse_response"] for parts in (day, night))
    np.testing.assert_allclose(first, second, rtol=1e-5)
    loaded = mi.load_dict({"type": "scene", **no_none(day)})
    assert find_lidar_scene(loaded, loaded.sensors()[0]).transmitter.pulse_energy > 0
    # And the laser does not light a picture.
    dark = render({**day, "integrator": PASSIVE})
    np.testing.assert_allclose(dark["radiance"], render(scene("2x2"))["radiance"], rtol=1e-10)


@refuses(
    ({"sun": None, "sky": None}, "needs a sun or a sky"),
    ({"sun2": {"type": "sun"}}, "more than one sun"),
    ({"lamp": {"type": "point"}}, "type = .point. is not loaded.*from sun and sky"),
    ({"sun": {"type": "sun", "zenith_deg": 20.0}}, "degrees from where it is"),
)
def test_scenes_that_are_refused(parts):
    render(scene(**parts))
