"""Renders from the command line with a pulse, a profile of the water and a seabed as instruments write them."""

import numpy as np
import pytest
from command_line import run

import mitransient_lidar
from mitransient_lidar.physics.water.profiles import Profile

SCENE = """<scene version="3.0.0">
    DEFAULTS
    <integrator type="lidar_volpath"><integer name="paths_per_pass" value="16384"/></integrator>
    <emitter type="lidar_transmitter"><string name="pulse_file" value="PULSE"/></emitter>
    <sensor type="multipixel_receiver">
        <film type="time_gated_film">
            <float name="time_start_ns" value="1400"/><float name="bin_width_ns" value="1"/>
            <integer name="bin_count" value="140"/>
        </film>
    </sensor>
    <shape type="ocean_surface">
        <string name="spectrum" value="flat"/>
        <medium type="layered_water" name="interior">WATER</medium>
    </shape>
    <shape type="seabed">SEABED<float name="size" value="100"/></shape>
</scene>"""

# Up the wire, in centimetres and per kilometre, one depth twice and one without attenuation.
PROFILE = (
    "\ufeffProbe 7;;;\r\nStation: harbour\r\n\r\nbb(532);Depth;c532;T;a(532)\r\n1/km;cm;1/m;degC;1/m\r\n"
    "20;600;0,625;8,1;0,25\r\n10;300;0,5;8,1;0,125\r\n10;300;0,25;8,3;0,125\r\n10;150;n/a;8,3;0,125\r\n5;0;0,25;9;0,125\r\n"
)
PULSE = "# Oscilloscope\nV      t [ps]\n0.0    -4000\n2.0    0\n0.5    2000\n0.0    8000\n"
DEPTHS = np.array([[6.0, 6.5, 7.0, 7.5], [6.0, 6.5, 7.0, 7.5], [6.5, 6.5, 7.5, 8.0], [7.0, 7.0, 7.5, 8.0]])


def write_scene(path, **parts):
    text = SCENE
    for name, part in parts.items():
        text = text.replace(name, part)
    path.write_text(text)
    return path


def xml(**values):
    return "".join(f'<string name="{name}" value="{value}"/>' for name, value in values.items())


@pytest.fixture
def measured(tmp_path):
    """Scene with parameters for its files, and the files as -D options."""
    (tmp_path / "water.csv").write_bytes(PROFILE.encode())
    (tmp_path / "pulse.txt").write_text(PULSE)
    header = "ncols 4\nnrows 4\nxllcorner 512330\nyllcorner 6543190\ncellsize 10\n"
    rows = "\n".join(" ".join(map(str, row)) for row in DEPTHS[::-1])
    (tmp_path / "bottom.asc").write_text(header + rows)
    seabed = xml(filename="$map", map_values="depths")
    origin = '<float name="origin_x" value="$map_x"/><float name="origin_y" value="6543205"/>'
    files = {"pulse": tmp_path / "pulse.txt", "profile": tmp_path / "water.csv", "map": tmp_path / "bottom.asc"}
    given = {**files, "map_x": 512345}
    defaults = "".join(f'<default name="{name}" value="none"/>' for name in given)
    parts = {"PULSE": "$pulse", "WATER": xml(profile="$profile"), "SEABED": seabed + origin}
    scene = write_scene(tmp_path / "measured.xml", DEFAULTS=defaults, **parts)
    return scene, [f"-D{name}={value}" for name, value in given.items()]


@pytest.mark.slow
def test_files_render_like_the_same_values_typed(tmp_path, measured):
    scene, options = measured
    column = Profile([0, 3, 6], [0.125, 0.125, 0.25], [0.125, 0.25, 0.375], [0.005, 0.01, 0.02]).layers()
    names = ("layer_tops", "attenuation", "scattering", "backscattering")
    water = {name: ", ".join(map(repr, getattr(column, name).tolist())) for name in names}
    np.savez(tmp_path / "map.npz", heights=-DEPTHS, x=[-10.0, 0, 10, 20], y=[-10.0, 0, 10, 20])
    (tmp_path / "plain.csv").write_text("-4,0\n0,2\n2,0.5\n8,0\n")
    seabed = xml(filename=tmp_path / "map.npz") + '<float name="depth" value="0"/>'
    parts = {"DEFAULTS": "", "PULSE": str(tmp_path / "plain.csv"), "WATER": xml(**water), "SEABED": seabed}
    typed = write_scene(tmp_path / "typed.xml", **parts)
    results = []
    for path, given in ((scene, options), (typed, [])):
        done = run("render", path, *given, "--passes", 2, "--seed", 3, "--no-plot", "-o", tmp_path)
        assert done.exit_code == 0, done.output
        results.append(mitransient_lidar.open(path.with_suffix(".nc")))
    for name in ("impulse_response", "waveform"):
        assert float(results[0][name].sum()) > 0
        np.testing.assert_array_equal(results[0][name], results[1][name])


def test_an_origin_far_outside_the_map_is_refused_before_anything_is_written(tmp_path, measured):
    scene, options = measured
    done = run("render", scene, *options[:-1], "-Dmap_x=412345", "--passes", 2, "-o", tmp_path / "out")
    assert done.exit_code == 2
    # Above it is what the log tells of the other files.
    last = done.stderr.splitlines()[-1]
    allowed = f"origin_x = 412345 must lie within 10 km of {tmp_path / 'bottom.asc'}, whose x is 512335 to 512365"
    assert last == f"{allowed} (origin_x is set by map_x = 412345)"
    assert not (tmp_path / "out").exists()
