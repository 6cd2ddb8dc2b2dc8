"""A flight over a GeoTIFF in UTM along an SBET trajectory, from its files to points that laspy reads."""

import json
import math

import laspy
import numpy as np
import pytest

from mitransient_lidar import scenes
from mitransient_lidar.flights.fly import fly

pytestmark = pytest.mark.long

#: End of the flight line in EPSG:32633, and height of the lidar above the sea [m].
PLACE, HEIGHT = (500_040.0, 6_500_040.0), 75.0

#: Time of the first record in its GPS week [s].
START = 302_400.0

SCENE = """<scene version="3.0.0">
    <include filename="{shared}/_lidar.xml"/>
    <shape type="ocean_surface" id="surface"><medium type="layered_water" name="interior"/></shape>
    <shape type="seabed" id="bottom">
        <string name="filename" value="{folder}/step.tif"/>
        <float name="reflectance" value="0.15"/>
    </shape>
</scene>
"""


def write_geotiff(path):
    """Write a bottom that is 4 m deep west of easting 500040, and 6 m deep east of it."""
    rasterio = pytest.importorskip("rasterio")
    heights = np.full((80, 80), -4.0, "float32")
    heights[:, 40:] = -6
    about = {"driver": "GTiff", "width": 80, "height": 80, "count": 1, "dtype": "float32", "crs": "EPSG:32633"}
    with rasterio.open(path, "w", **about, transform=rasterio.Affine(1, 0, 500_000, 0, -1, 6_500_080)) as file:
        file.write(heights, 1)


def write_sbet(path):
    """Write a second of level flight along grid east at 40 m/s up to the place, with records of 5 ms."""
    pyproj = pytest.importorskip("pyproj")
    time = START + np.arange(201) * 5e-3
    x, y = PLACE[0] - 40 + 40 * (time - START), np.full(time.shape, PLACE[1])
    grid = pyproj.CRS.from_epsg(32633)
    longitude, latitude = pyproj.Transformer.from_crs(grid, 4326, always_xy=True).transform(x, y)
    # Grid north is the true heading of the meridian convergence.
    convergence = pyproj.Proj(grid).get_factors(longitude, latitude).meridian_convergence
    record = np.zeros((time.size, 17))
    record[:, 0], record[:, 1], record[:, 2] = time, np.radians(latitude), np.radians(longitude)
    record[:, 3], record[:, 9] = HEIGHT, np.radians(90.0 + convergence)
    record.astype("<f8").tofile(path)


def test_points_lie_where_map_and_trajectory_have_them(tmp_path, in_this_process):
    """The signal is clipped: flags and errors of saturated echoes are seen, and the bottom is found all the same.

    A map about its centre, the usual one, would be half a cell off at the step, and wrong by 2 m beside it.
    """
    write_geotiff(tmp_path / "step.tif")
    write_sbet(tmp_path / "line.sbet")
    (tmp_path / "own.xml").write_text(SCENE.format(shared=scenes.__path__[0], folder=tmp_path))
    # The scene begins at a round corner of the map, 0.5 m beside the first cell.
    origin = [500_000.0, 6_500_000.0, 0.0]
    flight = {
        **{"scene": str(tmp_path / "own.xml"), "instrument": "riegl_vq840gl", "target_error": 0.2, "still_sea": True},
        **{"surface_radius": 0, "crs": "EPSG:32633", "origin": origin, "seed": 1},
        "parameters": {"spectrum": "flat", "jerlov": "1C"},
        "platform": {"kind": "sbet", "file": str(tmp_path / "line.sbet"), "epsg": 32633, "origin": origin},
        "scanner": {"kind": "fixed", "nadir_angle_deg": 14.0},
        "pulses": {"rate_hz": 16.0},
        "receiver": {"chain": "apd", "gain": 1.0},
    }
    points = fly(json.loads(json.dumps(flight)), tmp_path / "out", workers=1)
    cloud = laspy.read(tmp_path / "out" / "points.laz")
    bottom = np.flatnonzero(np.asarray(cloud.classification) == 40)
    assert len(bottom) >= 14
    places, times, depths = np.asarray(cloud.xyz), np.asarray(cloud.gps_time), np.asarray(cloud["depth"])
    for row in bottom[[0, len(bottom) // 2, -1]]:
        # Forward at 14 degrees from nadir: to the east, and refracted at the surface from which the depth counts.
        surface, sine = places[row, 2] + depths[row], math.sin(math.radians(14))
        ahead = (HEIGHT - surface) * math.tan(math.radians(14)) + depths[row] * math.tan(math.asin(sine / 1.34))
        by_hand = PLACE[0] - 40 + 40 * (times[row] - START) + ahead, PLACE[1]
        np.testing.assert_allclose(places[row, :2], by_hand, atol=0.01)
        assert abs(surface) < 0.2
    x, _, z = places[bottom].T
    beside = np.abs(x - 500_040) > 1
    assert np.abs(np.where(x < 500_040, -4, -6) - z)[beside].max() < 0.1
    assert {round(float(value)) for value in z[beside]} == {-4, -6}
    # Times are of the week, and what is saturated is withheld, with errors that hold.
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    saturated = np.asarray(cloud["quality"]) & 1 > 0
    assert np.asarray(cloud.withheld)[saturated].any()
    assert not np.asarray(cloud.withheld)[~saturated].any()
    error = points["z"].values - points["true_z"].values
    own = points["withheld"].values & (points["kind"].values == 40) & (np.abs(points["x"].values - 40) > 1)
    assert np.sqrt(np.mean((error[own] / points["vertical_uncertainty"].values[own]) ** 2)) < 1.3
