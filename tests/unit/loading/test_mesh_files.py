"""PLY files, whose counts and indices Mitsuba trusts."""

import hashlib
import json

import mitsuba as mi
import numpy as np
import pytest
from array_inputs import mesh
from rows import each_case, must_refuse

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.checks import check_ply
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import open_scene


@pytest.fixture(params=["a.ply", "a_binary.ply"])
def square(request, tmp_path):
    """PLY file of a square of two triangles, as text and as binary records."""
    return mesh(request.param)(tmp_path)


def change(path, old, new):
    data = path.read_bytes()
    assert data.count(old) == 1
    path.write_bytes(data.replace(old, new))


def with_index(path, index):
    """Replace the last index of the last triangle."""
    if "binary" in path.name:
        path.write_bytes(path.read_bytes()[:-4] + np.array(index, dtype="<i4").tobytes())
    else:
        change(path, b"3 0 2 3\n", f"3 0 2 {index}\n".encode())


@pytest.mark.parametrize("index", [4, 2_000_000_000, -5, 2**31 - 1])
def test_faces_without_a_vertex_are_refused(square, index):
    with_index(square, index)
    scene = {"type": "scene", "mesh": {"type": "ply", "filename": str(square)}}
    must_refuse(f"has a face with the vertex {index}, and the vertices 0 to 3 alone", open_scene, scene)


def test_the_mesh_of_a_result_is_checked(square):
    """Its SHA-256 is right: whoever makes the result makes the mesh."""
    good = {"type": "scene", "mesh": {"type": "ply", "filename": str(square)}}
    record = SceneSource.of_dict(good)
    with_index(square, 4)
    digest = hashlib.sha256(square.read_bytes()).hexdigest()
    rows = [{"plugin": "ply", "name": str(square), "path": str(square), "sha256": digest}]
    changed = {**record.attributes(), "scene_files": json.dumps(rows)}
    must_refuse("has a face with the vertex 4", lambda: open_scene(SceneSource.from_attributes(changed)))


@each_case(
    (b"element vertex 4", b"element vertex 5"),
    (b"element vertex 4", b"element vertex 4294967300"),
    (b"element vertex 4", b"element vertex -1"),
    (b"element face 2", b"element face 1000000000000"),
    (b"element face 2", b"element face 3"),
    (b"element face 2", b"element vertex 2"),
    (b"element face 2", b"element nothing 99999999999999\nelement face 2"),
    (b"property list uchar int vertex_indices", b"property list uchar none vertex_indices"),
    (b"end_header", b"end_of_header"),
    (b"ply\n", b"ply\ncomment " + b"x" * 5000 + b"\n"),
    (b"element face 2", b"element \x1b]0;title\x07 0\nelement face 2"),
)
def test_headers_that_lie_are_refused(old, new, square):
    change(square, old, new)
    must_refuse(r"is damaged, or is not a PLY file of triangles|has a face with the vertex", check_ply, square)


def test_a_message_that_quotes_other_bytes_than_text_is_a_sentence(tmp_path):
    path = mesh("a.obj")(tmp_path)
    path.write_bytes(path.read_bytes() + b"v 1 \xf6 2\n")
    with pytest.raises(UserError, match="could not parse line") as caught:
        open_scene({"type": "scene", "mesh": {"type": "obj", "filename": str(path)}})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("order", ["little", "big"])
def test_checks_agree_with_what_mitsuba_reads(tmp_path, order):
    """Both byte orders, with more properties and elements than Mitsuba uses, and more records than a part."""
    rng = np.random.default_rng(1)
    mark = "<" if order == "little" else ">"
    vertices = np.zeros(1000, dtype=[(name, f"{mark}f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
    for name in vertices.dtype.names:
        vertices[name] = rng.normal(size=1000)
    faces = np.zeros(150_000, dtype=[("count", "u1"), ("i", f"{mark}u4", 3), ("quality_x", f"{mark}f8")])
    faces["count"], faces["i"] = 3, rng.integers(0, 1000, (150_000, 3))
    head = ["ply", f"format binary_{order}_endian 1.0", "element vertex 1000"]
    head += [f"property float {name}" for name in vertices.dtype.names]
    head += [f"element face {len(faces)}", "property list uchar uint vertex_indices", "property double quality_x"]
    path = tmp_path / "a.ply"

    def write():
        path.write_bytes(("\n".join([*head, "end_header\n"])).encode() + vertices.tobytes() + faces.tobytes())

    write()
    check_ply(path)
    loaded = mi.load_dict({"type": "ply", "filename": str(path)})
    found = np.array(mi.traverse(loaded)["faces"]).reshape(-1, 3)
    np.testing.assert_array_equal(found, faces["i"])
    faces["i"][-1, 2] = 1000
    write()
    must_refuse("has a face with the vertex 1000", check_ply, path)


@pytest.mark.parametrize("kind", ["gridvolume", "sdfgrid"])
def test_grids_of_other_sizes_than_their_header_says_are_refused(tmp_path, kind):
    path = tmp_path / "grid.vol"
    mi.VolumeGrid(np.linspace(-0.5, 0.5, 24, dtype=np.float32).reshape(2, 3, 4, 1)).write(str(path))
    grid = {"type": kind, "filename": str(path)}
    texture = {"type": "volume", "volume": grid}
    held = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}} if kind == "gridvolume" else grid
    assert open_scene({"type": "scene", "part": held}).scene.shapes()
    data = path.read_bytes()
    for counts in ((2**30,) * 3, (4, 3, 3), (-4, -3, 2)):
        path.write_bytes(data[:8] + np.array(counts, "<i4").tobytes() + data[20:])
        with pytest.raises(UserError, match=r"grid.vol has \d+ bytes, and says that it holds .* cells"):
            open_scene({"type": "scene", "part": held})
    path.write_bytes(b"VOL")
    must_refuse(r"grid.vol is damaged, or is not a grid of Mitsuba", open_scene, {"type": "scene", "part": held})
