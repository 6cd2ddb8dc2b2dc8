"""Rendering of results again: the same bits of every variable, and what is refused."""

import json

import mitsuba as mi
import numpy as np
import pytest
from command_line import assert_refused, run
from few_paths import few_paths
from rows import must_refuse
from same_bits import assert_same_bits

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import catalogue
from mitransient_lidar.rendering.passive import render_passive
from mitransient_lidar.rendering.render import render_again
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.results import save

FEW = {"type": "lidar_volpath", "paths_per_pass": 4096}
SMALL = {"surface_size": "60", "bin_width_ns": "4", "bin_count": "40"}


def scene_dict(tmp_path, **water):
    """Return a scene of Python objects with a file, a rotated target of Mitsuba's, and a nested BSDF of ours."""
    profile = tmp_path / "profile.csv"
    profile.write_text("depth,a,b\n0,0.15,0.15\n10,0.2,0.3\n")
    turned = mi.ScalarTransform4f().translate([0, 0, -4.1]).rotate([0, 1, 0], 33).scale(0.7)
    return {
        "integrator": FEW,
        "tx": {"type": "lidar_transmitter", "divergence_mrad": 5.0},
        "rx": {
            "type": "multipixel_receiver",
            "layout": "1x1",
            "film": {"type": "time_gated_film", "bin_width_ns": 2.0, "bin_count": 80},
        },
        "sea": {
            "type": "ocean_surface",
            "spectrum": "flat",
            "interior": {"type": "layered_water", "profile": str(profile), "profile_tolerance": 0.1, **water},
        },
        "target": {"type": "rectangle", "to_world": turned, "bsdf": {"type": "retroreflector"}},
        "bottom": {"type": "seabed", "depth": 8.0, "size": np.float64(200)},
    }


@pytest.fixture(scope="module")
def table():
    """A result of a shipped scene with waves."""
    return mitransient_lidar.render("table1", params={**SMALL, "jerlov": "1C"}, integrator=FEW, passes=2, seed=7)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with the file of `own`."""
    return tmp_path_factory.mktemp("own")


@pytest.fixture(scope="module")
def own(folder):
    """A result of a scene of Python objects."""
    return mitransient_lidar.render(scene_dict(folder), passes=2)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".nc", ".exr"])
def test_a_result_and_its_files_give_the_same_bits(suffix, table, tmp_path):
    first = table
    path = tmp_path / f"a{suffix}"
    results.save(first, path)
    again = mitransient_lidar.render(path)
    assert_same_bits(first, again)
    changing = {"history", "elapsed_s"}
    assert {name for name, value in first.attrs.items() if again.attrs[name] != value} <= changing
    assert '<string name="jerlov" value="$jerlov"/>' in first.attrs["scene_xml"]
    values = json.loads(first.attrs["plugin_parameters"])
    assert values["surface"]["interior"]["jerlov"] == first.attrs["scene.jerlov"] == "1C"
    assert values["integrator"]["paths_per_pass"] == 4096
    assert values["surface"]["size"] == "60"
    assert values["surface"]["used"]["size"] == 60


@pytest.mark.slow
def test_given_options_win(own):
    other = mitransient_lidar.render(own, seed=1, passes=3, integrator={**FEW, "paths_per_pass": 2048})
    assert (other.attrs["seed"], other.attrs["passes"]) == (1, 3)
    assert json.loads(other.attrs["plugin_parameters"])["integrator"]["paths_per_pass"] == 2048
    assert_same_bits(mitransient_lidar.render(other, seed=0, passes=2, integrator=FEW), own)


@pytest.mark.slow
def test_scenes_of_python_give_the_same_bits_with_their_files_alone(own, folder):
    first, path = own, folder / "profile.csv"
    (file,) = json.loads(first.attrs["scene_files"])
    assert (file["plugin"], file["name"]) == ("layered_water", str(path))
    text = path.read_text()
    path.write_text(text.replace("0.3", "0.31"))
    must_refuse(r"profile\.csv has changed since the result was rendered", mitransient_lidar.render, first)
    path.unlink()
    must_refuse(r"profile\.csv is missing", mitransient_lidar.render, first)
    path.write_text(text)
    assert_same_bits(first, mitransient_lidar.render(first))


@pytest.mark.slow
@pytest.mark.parametrize("place", ["first"])
def test_a_camera_beside_the_receiver_is_left_alone(own, tmp_path, place):
    looking = mi.ScalarTransform4f().look_at([0, 0, 90], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 6, "pixel_format": "luminance"}
    camera = {"camera": {"type": "perspective", "to_world": looking, "film": film}}
    scene = scene_dict(tmp_path)
    scene = {**camera, **scene} if place == "first" else {**scene, **camera}
    result = mitransient_lidar.render(scene, passes=2, seed=own.attrs["seed"])
    np.testing.assert_array_equal(result["waveform"], own["waveform"])
    described = json.loads(result.attrs["plugin_parameters"])["camera"]
    np.testing.assert_allclose(described["to_world"], looking.matrix, atol=1e-6)
    assert described["film"]["size"] == [8, 6]
    assert_same_bits(render_again(result), result)


@pytest.mark.slow
@pytest.mark.parametrize("function", [mitransient_lidar.render])
def test_a_result_of_another_receiver_gives_the_same_bits(function, tmp_path):
    poses = '<float name="aim_x" value="$aim_x"/><float name="aim_y" value="$aim_y"/>'
    receivers = "".join(
        f'<sensor type="multipixel_receiver" id="{name}"><string name="layout" value="1x{number}"/>{poses}'
        '<film type="time_gated_film"><integer name="bin_count" value="80"/></film></sensor>'
        for number, name in enumerate(("single", "pair"), start=1)
    )
    (tmp_path / "two.xml").write_text(
        '<scene version="3.0.0"><default name="aim_x" value="0"/><default name="aim_y" value="0"/><emitter type="sky"/>'
        f'<integrator type="lidar_volpath"><integer name="paths_per_pass" value="4096"/></integrator>{receivers}'
        f'<emitter type="lidar_transmitter">{poses}</emitter><shape type="ocean_surface"><string name="spectrum" '
        'value="flat"/><medium type="layered_water" name="interior"/></shape></scene>'
    )
    options = {"passes": 2, **({"positions": [(0, 0), (1, 1)]} if function is render_shots else {})}
    for name, number in (("", 1), ("pair", 2)):
        result = function(tmp_path / "two.xml", sensor=name, **options)
        assert result.sizes["pixel"] == number
    assert_same_bits(render_again(result), result)
    with pytest.raises(UserError, match="sensor = 'sky' is no receiver of the scene: it has 'single', 'pair'"):
        function(tmp_path / "two.xml", sensor="sky", **options)


@pytest.mark.slow
def test_textures_give_the_same_bits(tmp_path):
    """Bitmaps of a file and of Python, from the file of the result, also with its bitmap in another folder."""
    picture, elsewhere = tmp_path / "grey.png", tmp_path / "elsewhere"
    mi.Bitmap(np.tile(np.uint8([[40, 200], [200, 40]]), (4, 4))[:, :, None]).write(str(picture))
    scene = scene_dict(tmp_path)
    turned = mi.ScalarTransform3d().rotate(30).scale([4, 6])
    scene["target"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": turned}}
    bitmap = {"type": "bitmap", "filename": str(picture)}
    scene["bottom"]["bsdf"] = {"type": "diffuse", "reflectance": bitmap}
    own = {"type": "bitmap", "bitmap": mi.Bitmap(np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8, 1)), "raw": True}
    scene["target"]["bsdf"]["reflectance"]["color0"] = own
    result = mitransient_lidar.render(scene, passes=2)
    results.save(result, tmp_path / "result.nc")
    assert_same_bits(render_again(tmp_path / "result.nc"), result)
    assert json.loads(result.attrs["scene_files"])[1]["path"] == str(picture.resolve())
    picture.write_bytes(picture.read_bytes() + b" ")
    must_refuse(r"grey.png has changed", render_again, tmp_path / "result.nc")
    elsewhere.mkdir()
    (elsewhere / "grey.png").write_bytes(picture.read_bytes()[:-1])
    assert_same_bits(render_again((tmp_path / "result.nc").rename(elsewhere / "result.nc")), result)


@pytest.mark.slow
def test_files_of_an_xml_scene_are_found_from_another_folder(tmp_path, monkeypatch):
    """A mesh is named relative to the scene, a profile to the working folder; both are recorded by their paths."""
    home, other = tmp_path / "home", tmp_path / "other"
    for folder in (home, other):
        folder.mkdir()
    mesh = '<shape type="ply" id="target"><string name="filename" value="target.ply"/></shape>'
    (home / "own.xml").write_text(catalogue.scene_text("table1").replace("</scene>", f"{mesh}</scene>"))
    mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, -5])}).write_ply(
        str(home / "target.ply")
    )
    (tmp_path / "profile.csv").write_text("depth,a,b\n0,0.15,0.15\n10,0.2,0.3\n")
    monkeypatch.chdir(tmp_path)
    params = {**SMALL, "spectrum": "flat", "profile": "profile.csv"}
    first = mitransient_lidar.render(home / "own.xml", params=params, integrator=FEW, passes=2)
    assert {file["path"] for file in json.loads(first.attrs["scene_files"])} == {
        str(tmp_path / "profile.csv"),
        str(home / "target.ply"),
    }
    monkeypatch.chdir(other)
    assert_same_bits(first, mitransient_lidar.render(first))
    (other / "new.csv").write_text("depth,a,b\n0,0.15,0.15\n10,0.2,0.35\n")
    changed = mitransient_lidar.render(first, params={"profile": "new.csv"})
    assert not np.array_equal(changed["waveform"], first["waveform"])
    assert_same_bits(changed, mitransient_lidar.render(changed))
    # A parameter that is given names the file of the working folder, also where it has the recorded name.
    (other / "profile.csv").write_text((other / "new.csv").read_text())
    assert_same_bits(changed, mitransient_lidar.render(first, params={"profile": "profile.csv"}))


@pytest.mark.slow
def test_what_cannot_be_rendered_again_is_refused(own, folder):
    loaded = mi.load_dict({"type": "scene", **scene_dict(folder)})
    first = mitransient_lidar.render(loaded, passes=2)
    assert not [name for name in first.attrs if name in ("scene_xml", "scene_dict")]
    must_refuse(r"does not hold its scene .* rendered from loaded objects", mitransient_lidar.render, first)
    assert json.loads(first.attrs["plugin_parameters"])["sea"]["interior"]["profile_tolerance"] == 0.1
    must_refuse("not a result that can be rendered again", lambda: mitransient_lidar.render(first.drop_attrs()))
    for params, message in ((5, "params = 5 must be a dict"), ({"a": 1}, "need an XML scene")):
        must_refuse(message, mitransient_lidar.render, own, params=params)


@pytest.mark.slow
def test_gates_alone_give_the_same_bits(tmp_path):
    """Without memory for histograms, gates are summed directly; the limit of memory is repeated, too."""
    params = {"layout": "16x16", "surface_cell_size": 0.2}
    first = mitransient_lidar.render("gated_mine", params=params, integrator=FEW, passes=2, max_memory=0.003)
    assert "waveform" not in first
    save(first, tmp_path / "a.exr")
    save(first, tmp_path / "all" / "a")
    for path in (tmp_path / "a.exr", tmp_path / "all" / "a_gate000.exr"):
        assert_same_bits(first, mitransient_lidar.render(path))


@pytest.mark.slow
def test_passes_that_were_reduced_give_the_same_bits():
    """A time limit that full passes exceed, in a dense plume, leads to smaller passes, whose share is repeated."""
    plume = {"plume_scattering": 20, "surface_cell_size": 0.5}
    first = mitransient_lidar.render("ship_wake", params=plume, integrator="lidar_volpath", max_time=0.5)
    assert first.attrs["pass_share"] < 1
    assert_same_bits(first, mitransient_lidar.render(first))


@pytest.mark.slow
def test_batches_of_passes_add_up_to_the_waveform(tmp_path):
    options = {"integrator": FEW, "passes": 5, "batches": 2, "pass_share": 0.5}
    first = mitransient_lidar.render("table1", params={"layout": "1x1", "spectrum": "flat"}, **options)
    assert first["batch_passes"].values.tolist() == [3, 2]
    mean = first["waveform_batch"].weighted(first["batch_passes"]).mean("batch")
    np.testing.assert_allclose(mean, first["waveform"], rtol=1e-12)
    results.save(first, tmp_path / "a.nc")
    again = mitransient_lidar.render(tmp_path / "a.nc")
    assert_same_bits(first, again)
    np.testing.assert_array_equal(first["waveform_batch"], again["waveform_batch"])
    with pytest.raises(UserError, match="with 200 batches of passes takes"):
        mitransient_lidar.render("table1", **{**options, "batches": 200, "max_memory": 0.001})


@pytest.mark.slow
def test_series_of_shots_give_the_same_bits(tmp_path):
    """Places, truth and a target that goes with the shots are repeated, with parameters that shots replace."""
    params = {**SMALL, "target_x": 1, "target_depth": 5}
    first = render_shots(few_paths("fig13_2x2", tmp_path), params, count=2, move_target=True, passes=2)
    assert json.loads(first.attrs["series_parameters"]) == {
        "aim_x": "0",
        "aim_y": "0",
        "target_x": "1",
        "target_y": "0",
    }
    results.save(first, tmp_path / "a.nc")
    assert_same_bits(first, mitransient_lidar.render(tmp_path / "a.nc"))
    deeper = render_again(first, params={"target_depth": 6})
    assert not np.array_equal(deeper["waveform"], first["waveform"])
    np.testing.assert_array_equal(deeper["aim_x"], first["aim_x"])
    must_refuse("rendered again as a whole", mitransient_lidar.render, first.isel(shot=[1]))
    assert_refused(run("render", tmp_path / "a.nc"), "result of the command shots: use shots")
    assert_refused(run("shots", tmp_path / "a.nc", "--seed", 2, "-o", tmp_path / "b.nc"), "leave out seed")
    done = run("shots", tmp_path / "a.nc", "-o", tmp_path / "b.nc", "-q")
    assert done.exit_code == 0, done.stderr
    assert_same_bits(first, results.open(tmp_path / "b.nc"))


@pytest.mark.slow
def test_daylight_gives_the_same_bits(tmp_path):
    params = {"layout": "4x4", "surface_cell_size": 2}
    few = {"type": "passive_volpath", "paths_per_pass": 4096}
    first = render_passive("passive_sea", params, integrator=few, passes=[2, 3], frames=2, filter_width_nm=2.0)
    assert first.attrs["frame_passes"] == [2, 3]
    for suffix in (".nc", ".exr"):
        save(first, tmp_path / f"a{suffix}")
        assert_same_bits(first, mitransient_lidar.render(tmp_path / f"a{suffix}"))
    assert mitransient_lidar.render(first, frames=1, passes=2).sizes.get("frame", 1) == 1
    done = run("passive", tmp_path / "a.exr", "-o", tmp_path / "b", "--no-plot", "-q")
    assert done.exit_code == 0, done.stderr
    assert_refused(run("render", tmp_path / "a.nc"), "result of the command passive: use passive")
