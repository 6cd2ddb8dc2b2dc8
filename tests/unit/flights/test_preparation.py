"""What is said of a flight before its first render: places of maps, coverage, corrections, cost and gain."""

import re

import mitsuba as mi
import pyproj
import pytest
from rows import each_row, must_refuse

from mitransient_lidar import scenes
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.las_header import check_same_system
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.preparation import check_maps
from mitransient_lidar.flights.renderer import scene_of

LINE = {"kind": "lines", "start": [-20.0, 0.0], "heading_deg": 90.0, "speed": 20.0, "height": 200.0, "duration_s": 2.0}
FLIGHT = {
    "scene": "flight",
    "platform": LINE,
    "scanner": {"kind": "palmer", "nadir_angle_deg": 20.0, "rate_hz": 10.0},
    "pulses": {"rate_hz": 100},
}

#: 4 x 3 cells of 10 m, whose centre is the point (500020, 6500015).
GRID = "ncols 4\nnrows 3\nxllcorner 500000\nyllcorner 6500000\ncellsize 10\n" + "-4 -5 -6 -7\n" * 3

#: A trajectory of two records in map coordinates.
RECORDS = "t,roll,pitch,yaw,x,y,z\n0,0,0,90,500005,6500015,200\n1,0,0,90,500035,6500015,200\n"


def from_file(folder, place, **others):
    """Return a flight along the records, whose platform has this origin."""
    (folder / "line.csv").write_text(RECORDS)
    platform = {"kind": "csv", "file": "line.csv", "origin": place}
    return FlightPlan.of_file({**FLIGHT, "platform": platform, **others}, folder)


def loaded_scene(folder, **parameters):
    (folder / "step.asc").write_text(GRID)
    bed = {"type": "seabed", "id": "bed", "filename": str(folder / "step.asc"), **parameters}
    return mi.load_dict({"type": "scene", "bed": bed})


@pytest.mark.parametrize("own", [{}, {"origin_x": 500010.0, "origin_y": 6500015.0}])
def test_a_map_lies_where_the_flight_has_its_points(tmp_path, own):
    """Without an origin a map lies about its centre: 10 m beside where its points would be written."""
    scene, place = loaded_scene(tmp_path, **own), [*(own.values() or (500020.0, 6500015.0)), 0.0]
    check_maps(from_file(tmp_path, place, crs="EPSG:32633", origin=place), scene)
    # Without coordinates of points, the trajectory's own ones count.
    check_maps(from_file(tmp_path, place), scene)
    other = [place[0], place[1] - 10, 0.0]
    for plan in (from_file(tmp_path, other, crs="EPSG:32633", origin=other), from_file(tmp_path, other)):
        must_refuse(r"the map of shape bed has .*: give the seabed origin_x = 5000\d0 and", check_maps, plan, scene)


@each_row((32633, None), (25833, None), (23033, "212"), (32632, r"3.48e\+05"), (None, None))
def test_maps_are_in_the_system_of_the_flight(of_map, beside, tmp_path):
    """The numbers of the place agree: the bottom of another zone would lie below the flight without a word."""
    if of_map is not None:
        (tmp_path / "step.prj").write_text(pyproj.CRS(of_map).to_wkt("WKT1_ESRI"))
    scene, place = loaded_scene(tmp_path), [500020.0, 6500015.0, 0.0]
    plan = from_file(tmp_path, place, crs="EPSG:32633", origin=place)
    if beside is None:
        check_maps(plan, scene)
    else:
        must_refuse(rf"shape bed .* are {beside} m beside .* in WGS 84 / UTM zone 33N: both", check_maps, plan, scene)
    # Without coordinates of points nothing is known of the flight.
    check_maps(from_file(tmp_path, place), scene)


OWN_SCENE = """<scene version="3.0.0">
    <default name="map_file" value="nowhere.tif"/>
    <include filename="{shared}/_lidar.xml"/>
    <shape type="ocean_surface" id="surface"><medium type="layered_water" name="interior"/></shape>
    <shape type="seabed"><string name="filename" value="$map_file"/>{own}</shape>
</scene>
"""


@each_row(
    ("", (500000.0, 6500000.0)), ('<float name="origin_x" value="1"/><float name="origin_y" value="2"/>', (1.0, 2.0))
)
def test_maps_lie_about_the_origin_of_the_flight(own, place, tmp_path):
    """A flight replaces defaults before anything is loaded: the file of the default is nowhere."""
    (tmp_path / "step.asc").write_text(GRID)
    (tmp_path / "own.xml").write_text(OWN_SCENE.format(shared=scenes.__path__[0], own=own))
    given = {**FLIGHT, "scene": "own.xml", "parameters": {"map_file": str(tmp_path / "step.asc")}}
    record = scene_of(
        FlightPlan.of_file({**given, "crs": "EPSG:32633", "origin": [500000.0, 6500000.0, 0.0]}, tmp_path)
    )
    text = record.document().filled(lambda setting: setting.value)
    found = tuple(float(re.search(f'name="origin_{axis}" value="(.*?)"', text)[1]) for axis in "xy")
    assert found == place
    assert record.parameters["map_file"] == "nowhere.tif"
    assert [path for path, _ in record.files.values()] == [str(tmp_path / "step.asc")]
    # Without map coordinates the map lies as it does in a render.
    assert ("origin_x" in scene_of(FlightPlan.of_file(given, tmp_path)).text) == bool(own)


def test_the_origin_of_a_platform_is_that_of_its_flight(tmp_path):
    place = [500020.0, 6500015.0, 40.0]
    # Heights may count from another datum.
    plan = from_file(tmp_path, place, crs="EPSG:32633", origin=[*place[:2], 0.0])
    assert plan.poses().origin[0, 0] == pytest.approx(-15)
    for wrong in ({"crs": "EPSG:32633"}, {"origin": [500021.0, 6500015.0, 0.0]}):
        with pytest.raises(UserError, match=r"origin = \[500020.0, .* of the platform must have the x and y of that"):
            from_file(tmp_path, place, **wrong).poses()


def test_an_sbet_file_is_in_the_system_of_the_points():
    pytest.importorskip("pyproj")
    for crs in ("EPSG:32633", "EPSG:32633+5773"):
        check_same_system(crs, 32633)
        must_refuse(r"epsg = 32634 of the platform must be .* crs = 'EPSG:32633", check_same_system, crs, 32634)
