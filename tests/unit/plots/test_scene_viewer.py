"""Pages of scenes and points: what is in them, and the commands that write them."""

import base64
import json
import re
import zlib

import numpy as np
import pytest
import xarray as xr
from command_line import assert_refused, run
from rows import must_refuse

from mitransient_lidar.flights.las import write_points
from mitransient_lidar.plots import viewer
from mitransient_lidar.plots.scene_viewer import page as traces
from mitransient_lidar.plots.scene_viewer.page import page_text
from mitransient_lidar.rendering.geometry import Bundle, Relief, SceneGeometry, Solid
from mitransient_lidar.results.attributes import PointClass

RING = np.array([[1.0, 0.0], [0.0, 2.0], [-1.0, 0.0], [0.0, -2.0], [1.0, 0.0]])


@pytest.fixture
def geometry():
    levels = [np.insert(share * RING, 2, z, axis=1) for share, z in ((0.0, 100.0), (1.0, 0.0), (1.5, -4.0))]
    box, lines = np.array([[-3.0, -3.0, -4.2], [3.0, 3.0, 0.5]]), np.linspace(-3, 3, 5)
    z = np.where(lines > 0, -4.0, np.nan) * np.ones((5, 1))
    reflectance = np.full((5, 5), 0.3)
    return SceneGeometry(
        "a </script> scene",
        box,
        {"laser": np.array([0.0, 0.0, 100.0])},
        [Relief("", True, lines, lines, 0 * z, 0 * z * np.nan), Relief("<b>mud", False, lines, lines, z, reflectance)],
        [Solid("leaves", np.eye(3), np.array([[0, 1, 2]]), np.nan, 0.25)],
        np.array([[depth, 0.9, 0.5] for depth in np.linspace(0.1, 4.0, 30)]),
        [Bundle("pixel only", "pixel", 0.0, (20e-3, 40e-3), [np.stack(levels)])],
    )


def figure_of(page):
    """Return the traces of a page by name, the last of those of one name."""
    packed = re.search(r'id="figure">([^<]*)<', page)[1]
    return json.loads(zlib.decompress(base64.b64decode(packed), -zlib.MAX_WBITS))["data"]


def array(given):
    kind = {"f4": "<f4", "u2": "<u2", "f8": "<f8"}[given["dtype"]]
    shape = [int(size) for size in given["shape"].split(",")] if "shape" in given else [-1]
    return np.frombuffer(base64.b64decode(given["bdata"]), kind).reshape(shape)


def of_scene(geometry):
    about = traces.scene_views(geometry), traces.scene_notes(geometry)
    return page_text(geometry.name, "scene", [*traces.scene_traces(geometry)], *about)


def test_a_page_holds_the_scene_with_names_and_numbers(geometry):
    page = of_scene(geometry)
    data = figure_of(page)
    named = {one["name"]: one for one in data}
    sea, mud = named["sea surface"], named["&lt;b&gt;mud"]
    assert array(mud["z"]) == pytest.approx(geometry.reliefs[1].z, nan_ok=True)
    assert array(mud["surfacecolor"]) == pytest.approx(np.full((5, 5), 0.3))
    assert "surfacecolor" not in sea
    assert mud["hovertext"] == "&lt;b&gt;mud<br>height -4 m<br>reflectance 0.3"
    assert named["leaves"]["hovertext"] == "leaves<br>height 0 to 1 m<br>1 × 1 × 1 m<br>reflectance unknown"
    pixel = [one for one in data if one["name"] == "pixel only"]
    assert [one["type"] for one in pixel] == ["scatter3d", "mesh3d"]
    # The footprint along x is 2 m on the sea and 3 m at the bottom, across it twice as much.
    assert pixel[0]["hovertext"] == (
        "pixel only<br>half angles 10 × 20 mrad<br>on the sea 2 × 4 m<br>where it ends 3 × 6 m, at a height of -4 m"
    )
    corners = np.stack([array(pixel[1][axis]) for axis in "xyz"], axis=1)
    triangles = corners[np.stack([array(pixel[1][axis]) for axis in "ijk"], axis=1)]
    # Walls between two levels and four rays, of which the first come to a point at the laser.
    area = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    assert (len(area), np.count_nonzero(area)) == (16, 12)
    layers = [one for one in data if one["name"].startswith("layer")]
    assert len(layers) == 10
    assert "0.9 /m above, 0.5 /m below" in layers[0]["hovertext"]
    assert "10 of 30 boundaries between layers are drawn." in page
    assert "leaves: a part of its triangles is drawn, 25% of them." in page
    views = traces.scene_views(geometry)
    assert views["Water"] is geometry.box
    assert views["Whole beam"][:, :2] == pytest.approx(geometry.box[:, :2])
    assert 100.0 < views["Whole beam"][1, 2] < 104.0


def test_a_page_needs_no_network_and_holds_text_as_text(geometry):
    page = of_scene(geometry)
    assert len(page) < 3e6
    assert "default-src 'none'" in page
    outside = re.sub(r'<script type="text/plain"[^<]*</script>', "", page)
    assert re.findall(r"https?://|\bsrc=|@import|url\(", outside) == []
    assert "<title>a &lt;/script&gt; scene · scene</title>" in page
    assert page.count("</script>") == 3
    assert "<b>mud" not in page


@pytest.fixture
def points():
    kinds = [PointClass.SURFACE, PointClass.BOTTOM, PointClass.BOTTOM, PointClass.NO_ECHO, 99]
    count = len(kinds)
    values = {
        "x": 500_001.0 + np.arange(count),
        "y": np.full(count, 7_000_002.0),
        "z": -np.arange(float(count)),
        "kind": np.array([int(kind) for kind in kinds]),
        "true_z": -np.arange(float(count)) - 0.05,
        "vertical_uncertainty": np.full(count, 0.1),
    }
    return xr.Dataset({name: ("point", column) for name, column in values.items()})


def test_points_have_classes_and_errors(points):
    drawn = list(traces.point_traces(points))
    assert [one["name"] for one in drawn] == ["bottom (2)", "water surface (1)", "no echo (1)", "class 99 (1)"]
    assert drawn[0]["customdata"] == pytest.approx(np.array([[10.0, 5.0]] * 2), rel=1e-5)
    assert "stated error %{customdata[0]:.1f} cm<br>error %{customdata[1]:.1f} cm" in drawn[0]["hovertemplate"]
    # A pulse without an echo has no error.
    assert drawn[2]["customdata"].shape == (1, 1)
    # Single precision holds coordinates that count from whole kilometres.
    assert drawn[0]["x"] == pytest.approx([2.0, 3.0])
    assert drawn[0]["y"] == pytest.approx([2.0, 2.0])
    (box,) = traces.point_views(points).values()
    assert np.all(box[0] < [1.0, 2.0, -4.0])
    assert np.all(box[1] > [5.0, 2.0, 0.0])
    (note,) = traces.point_notes(points)
    assert note.startswith("5 points. x and y count from 500000 and 7000000 m.")


def test_of_too_many_points_some_are_drawn(points, monkeypatch):
    monkeypatch.setattr(traces, "_MOST_POINTS", 2)
    assert sum(len(one["x"]) for one in traces.point_traces(points)) == 2
    assert traces.point_notes(points)[0].startswith("5 points, one in 3 drawn.")


def test_points_of_a_file(tmp_path):
    count = 3
    columns = dict.fromkeys(("scan_angle_deg", "line", "pixel", "shot", "quality", "withheld", "channel"), 0)
    columns |= {"return_number": 1, "number_of_returns": 1, "gps_time": 0.0, "intensity": 1.0}
    values = {name: np.full(count, value) for name, value in columns.items()}
    values |= {"x": np.arange(3.0), "y": np.ones(3), "z": [0.0, -4.0, -4.5], "kind": [41, 40, 40]}
    values["vertical_uncertainty"] = np.array([0.05, 0.1, np.nan])
    dataset = xr.Dataset({name: ("point", column) for name, column in values.items()})
    dataset["intensity"].attrs |= {"full_scale": 1.0, "units": "V"}
    write_points(tmp_path / "points.laz", dataset)
    data = {one["name"]: one for one in figure_of(viewer.view_points(tmp_path / "points.laz").page)}
    assert {*data} == {"bottom (2)", "water surface (1)"}
    assert array(data["bottom (2)"]["z"]) == pytest.approx([-4.0, -4.5], abs=1e-3)
    assert array(data["bottom (2)"]["customdata"]).ravel() == pytest.approx([10.0, np.nan], nan_ok=True)
    (tmp_path / "broken.las").write_bytes(b"LASF and no more")
    must_refuse(r"broken.las is no LAS file, or damaged", viewer.view_points, tmp_path / "broken.las")
    must_refuse(r"suffix must be .las or .laz", viewer.view_points, tmp_path / "points.csv")


@pytest.fixture
def seen(monkeypatch):
    """Arguments of the calls that would make the page of a scene."""
    calls = []
    made = lambda *given: calls.append(given) or viewer.View("<html></html>\n", "scene", 640)  # noqa: E731
    monkeypatch.setattr(viewer, "view_scene", made)
    return calls


def test_commands_write_the_page_of_a_scene(seen, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("scenes", "show", "table1", "--html")
    assert (done.exit_code, done.stdout) == (0, "table1.html\n")
    assert (tmp_path / "table1.html").read_text().startswith("<html>")
    done = run("view", "table1", "-D", "bottom_depth=5", "-o", "new/scene.html", "--no-browser")
    assert (done.exit_code, done.stdout) == (0, "new/scene.html\n")
    assert (tmp_path / "new/scene.html").read_text().startswith("<html>")
    assert seen == [("table1",), ("table1", {"bottom_depth": "5"})]
    assert run("scenes", "show", "table1").stdout.startswith("<")


def test_commands_refuse_what_does_not_go_with_a_scene(seen, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(run("view", "table1", "--plot"), "--plot needs a result: table1 is a scene or points")
    assert_refused(run("view", "shot.nc", "-D", "bottom_depth=5"), "-D needs a scene: shot.nc is none")
    assert_refused(run("view", "missing.laz", "--shot", 2), "--shot needs a result")
    assert_refused(run("view", "missing.laz"), "missing.laz")
    assert_refused(run("view", tmp_path), str(tmp_path))
    assert [*tmp_path.iterdir()] == seen == []
