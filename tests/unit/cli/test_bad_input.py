"""Invalid input: one sentence on stderr with parameter and value, exit code 2, no output and no file."""

import os
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
from command_line import assert_refused, run
from rows import each_row, refuses

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import catalogue, scenes
from mitransient_lidar.rendering.passes import Goal, run_passes

NAN = float("nan")


def rows(scene, table):
    """Return (scene, parameter, value, part of the sentence) of a table of parameters by value and part."""
    return [
        (scene, name, value, part)
        for (value, part), names in table.items()
        for name in (names.split() if isinstance(names, str) else names)
    ]


LASER = "pulse_energy_mj pulse_fwhm_ns divergence_mrad wavelength_nm optical_efficiency"
RECEIVER = "field_of_view_mrad aperture_area two_way_atmospheric_transmittance response_time_ns"
POSE = "altitude off_nadir_deg aim_x aim_y"
SEA = "wind_speed wind_direction_deg surface_time surface_size phase_g"
NUMBERS = f"{LASER} {RECEIVER} {POSE} {SEA} time_start_ns bin_width_ns bottom_depth bottom_reflectance"
LISTS = "layer_tops attenuation scattering backscattering water_scattering chi_p refractive_index group_index"

#: `test_parameters` tries the ends of all ranges; here are the ways from a scene to them, of which numbers share one.
TABLE1 = {
    ("inf", "must be finite"): NUMBERS.split()[::6],
    ("", "is empty: it must have a value"): [*NUMBERS.split()[1::6], "layer_tops", "bin_count", "layout"],
    ("deep", "must be a number"): [*NUMBERS.split()[2::6], "bin_count"],
    ("1 2", "must be one number"): "pulse_energy_mj altitude",
    ("1 2", "must be a number"): "divergence_mrad",
    ("1e30", "must lie between"): [*NUMBERS.split()[4::6], "attenuation", "layer_tops"],
    ("1.3,", "has an empty entry"): LISTS.split()[::3],
    (",", "is empty"): LISTS.split()[1::3],
    ("0.2, x", "must hold numbers only"): LISTS.split()[2::3],
    ("nan, 2", "must be finite"): "layer_tops scattering",
    ("1e12", "must be an integer"): "surface_seed",
    ("2.5", "must be an integer"): "bin_count",
    ("-8", "must not be negative: the scene uses it as -$bottom_depth"): "bottom_depth",
    ("2by2", "must be rows x columns"): "layout",
    ("0x2", "layout"): "layout",
    ("9999x9999", "at most 4194304"): "layout",
    ("hex8", "hexagons"): "layout",
    ("swell", "must be one of"): "spectrum",
    ("some", "must be"): "slope_variance surface_cell_size surface_refined_size",
    ("0.4", "must not exceed attenuation = 0.3"): "scattering",
    ("0.2", "must not exceed scattering = 0.15"): "backscattering",
    ("0.1", "scattering = 0.15 must not exceed"): "attenuation",
    ("0.2", "must be at least 0 and at most scattering"): "water_scattering",
    ("3, 0", "must start at 0 m"): "layer_tops",
}
#: Of the other scenes, one of each kind: their numbers take the same way.
OTHERS = [
    *rows(
        "fig02_mine", {("0", "must be greater than 0"): "target_size", ("-9", "must not be negative"): "target_depth"}
    ),
    *rows("gated_mine", {("0.5", "must be an integer"): "pulses", ("0", "must lie between"): "gate_width_ns"}),
    *rows("passive_sea", {("inf", "must be finite"): "plate_depth", ("1e9", "must lie between"): "sun_zenith_deg"}),
]
PARAMETERS = rows("table1", TABLE1) + OTHERS


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in an empty folder, which must stay empty."""
    inside = tmp_path / "work"
    inside.mkdir()
    monkeypatch.chdir(inside)
    yield inside
    assert list(inside.iterdir()) == []


def shows(sentence, value):
    """Return whether a sentence shows a value, or an entry of it, as it was typed or as a number."""
    forms = {value.strip(), value.partition(",")[0]}
    if re.fullmatch(r"[-+.\deE]+", value):
        forms |= {f"{float(value):g}", str(float(value))}
    return any(form in sentence for form in forms)


@each_row(*PARAMETERS)
def test_parameters_of_scenes(scene, name, value, part):
    with pytest.raises(UserError, match=re.escape(part)) as caught:
        scenes.open_scene(scene, {name: value})
    sentence = str(caught.value)
    assert name in sentence
    assert "\n" not in sentence
    assert shows(sentence, value)


@each_row(*PARAMETERS[::12])
def test_parameters_of_scenes_on_the_command_line(scene, name, value, part, folder):
    result = run("render", scene, "--passes", 2, "-D", f"{name}={value}")
    assert_refused(result, name, part)
    assert shows(result.stderr, value)


RENDER = ("render", "table1")
#: Numbers outside their ranges are tried in `test_contract`.
OPTIONS = [
    (RENDER, "--passes", "2.5", "must be a valid integer"),
    (RENDER, "--passes", "100000000000000000000", "must lie between 2 and 1000000000"),
    (RENDER, "--variant", "scalar_rgb", "is not supported: allowed are"),
    (RENDER, "--integrator", "path", "is not a lidar integrator"),
    (RENDER, "--integrator", "lidar_mergin", "did you mean lidar_merging"),
    (RENDER, "--integrator", "passive_volpath", "has no laser"),
    (RENDER, "-D", "altitude", "is not of the form name=value"),
    (RENDER, "-D", "altitud=3", "did you mean altitude"),
    (RENDER, "--output", "\udcff", "not valid UTF-8"),
    (RENDER, "--passs", "3", "No such option"),
    (("scenes", "instruments", "--json"), "--xml", "riegl_vq840g", "--xml and --json are alternatives"),
    (("compare", "a.nc", "b.nc", "--json"), "--output", "a.png", "--json draws nothing"),
    (("find-shots", "table1"), "--slope-sigmas", "20", "the sea has no place of the kind towards"),
    (("find-shots", "table1"), "--at", "3", "must be two numbers"),
    (("find-shots", "table1"), "--output", "a.txt", "must end in .png"),
    (("detect", "fig13_2x2"), "--depths", "4,,8", "has an empty entry"),
    (("detect", "fig13_2x2"), "--receiver", "eye", "must be one of ideal"),
    (("depth-bias", "eye"), "--seed", "1", "instrument = 'eye' is not known"),
    (("depth-bias", "riegl_vq880g2_infrared"), "--seed", "1", "wavelength_nm = 1064: depth errors are of green light"),
    (("depth-bias", "riegl_vq840g"), "--waters", ",", "--waters = ',' has an empty entry"),
    (("tpu", "icesat2_atlas"), "--seed", "1", "no shipped corrections of the instrument icesat2_atlas"),
]


@each_row(
    *(((*command, option, value), part) for command, option, value, part in OPTIONS),
    (["render"], "Missing argument 'SCENE'"),
    (["render", "table1", "two"], "Got unexpected extra argument"),
    (["rendr", "table1"], "No such command 'rendr'"),
    (["--fast"], "No such option: --fast"),
    (["scenes", "hide"], "No such command 'hide'"),
    (["render", "tabel1"], "did you mean table1"),
    (["render", "."], "is a folder"),
    (["render", "/dev/zero"], "cannot read /dev/zero: it is a device, and only regular files are read"),
    (["view", "/dev/zero"], "/dev/zero: it is a device"),
    (["view", "missing.nc"], "missing.nc"),
    (["echoes", "/dev/zero"], "/dev/zero"),
    (["scenes", "water", "mud"], "kind = 'mud' must be one of jerlov"),
    (["compare", "/dev/zero", "/dev/zero"], "/dev/zero: it is a device"),
    (["gates", "/dev/zero", "--start-ns", 1, "--width-ns", 1, "--count", 1], "/dev/zero"),
)
def test_commands_and_options(arguments, part, folder):
    assert_refused(run(*arguments), part)


def without(tag):
    """Return table1 without its first element of a tag."""
    end = tag.split()[0]
    return lambda text: re.sub(rf"<{tag}(?=[ />])[^>]*?(/>|>.*?</{end}>)", "", text, count=1, flags=re.DOTALL)


def replaced(old, new):
    """Return a change of the text of a scene, which must contain the old part."""

    def change(text):
        assert old in text
        return text.replace(old, new, 1)

    return change


@each_row(
    (without("sensor"), "sensor: the scene has none"),
    (without("emitter"), "emitters: the scene has 0 of which 0 are lidar_transmitter"),
    (without("film"), "film: sensor 'receiver' has none; add a time_gated_film"),
    (without("medium"), "ocean_surface 'surface': needs a layered_water as its interior medium"),
    (without("integrator"), "integrator: the scene has no lidar integrator"),
    (replaced("<film", '<float name="apertur_area" value="1"/><film'), "did you mean aperture_area"),
    (replaced('id="transmitter"/>', 'id="transmitter"><float name="divergense" value="1"/></emitter>'), "divergense"),
    (replaced('<float name="bin_width_ns"', '<float name="bin_with"'), "time_gated_film: there is no parameter"),
    (replaced('name="wind_speed" value="3"', 'name="wind_speed" value=""'), "wind_speed = '' is empty"),
    (replaced('"$bottom_reflectance"', '"1.2"'), "reflectance = 1.2 must lie between 0 and 1"),
    (replaced('type="sediment"', 'type="sedimnt"'), "did you mean sediment"),
    (replaced('type="lidar_transmitter"', 'type="lidar_transmiter"'), "did you mean lidar_transmitter"),
    (replaced('"-$bottom_depth"', '"-$bottom_dept"'), "z = '-$bottom_dept' refers to an unknown parameter"),
    (replaced('name="wind_speed" value="3"', 'name="wind_speed" value="inf"'), "wind_speed = inf must be finite"),
    (replaced('<scale value="500"/>', '<scale value="0"/>'), "scale = 0 must be greater than 0"),
    (replaced("<film", "<fillm"), "not well-formed"),
    (replaced('"3.0.0">', '"3.0.0"><bsdf type="diffuse" id="receiver"/>'), "duplicate"),
    (lambda text: "", "not well-formed XML"),
    (lambda text: '<shape type="sphere" version="3.0.0"/>', "has a root element <shape>: it must be <scene>"),
    (lambda text: f"<scene version='3.0.0'>{'<shape>' * 50_000}{'</shape>' * 50_000}</scene>", "more than 64 deep"),
)
def test_scene_files(change, part, tmp_path, folder):
    path = tmp_path / "scene.xml"
    text = re.sub('name="(\\w+)" +value', r'name="\1" value', catalogue.scene_text("table1"))
    path.write_text(change(re.sub(r"<(float|string|integer) +name", r"<\1 name", text)), "utf-8")
    assert_refused(run("render", path, "-q", "--no-plot", "--passes", 2), part)


def quietly(**options):
    return lambda: mitransient_lidar.render(**{"scene": "table1", "passes": 2, **options})


def as_dict(**parts):
    return quietly(scene={"type": "scene", **parts})


NESTED = {"type": "sphere"}
for _ in range(100):
    NESTED = {"type": "sphere", "child": NESTED}
SINGULAR = mi.ScalarTransform4f().scale(0)


@refuses(
    (quietly(scene=3), "scene = 3 must be a shipped name, a path, a dict or a loaded scene"),
    (quietly(passes="8"), "passes = '8' must be an integer between 2 and 1000000000"),
    (quietly(passes=np.array([3, 4])), "passes = array([3, 4]) must be an integer"),
    (quietly(variant=3), "variant = 3 is not supported"),
    (quietly(integrator=3), "integrator = 3 must be the name or the dict of an integrator"),
    (quietly(integrator={"type": "lidar_merging", "paths_per_pass": None}), "paths_per_pass = None must be"),
    (quietly(params=["altitude"]), "params = ['altitude'] must be a dict of names and values"),
    (quietly(params={"altitude": None}), "altitude = None must be a number, a text or a list"),
    (quietly(params={3: 4}), "parameter 3 is not one of scene table1"),
    (quietly(scene={}), "sensor: the scene has none"),
    (quietly(scene={"type": "scene", "x": 3}, params={"a": 1}), "params = ['a'] need an XML scene"),
    (as_dict(x=None), "x = None must be"),
    (as_dict(x={"type": "sphere", "radius": None}), "x.radius = None must be"),
    (as_dict(x={"type": "sphere", "radius": NAN}), "x.radius = nan must be finite"),
    (as_dict(x={"type": "sphere", "to_world": SINGULAR}), "x.to_world has a scale of 0"),
    (as_dict(x={"type": "multipixel_receiver", "aperture_area": 1e30}), "x.aperture_area = 1e+30 must lie between"),
    (
        as_dict(x={"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 2, 0]}}),
        "x.reflectance = 2 must lie between 0 and 1",
    ),
    (as_dict(x={"type": "diffuse", "reflectance": 1.5}), "x.reflectance = 1.5 must lie between 0 and 1"),
    (as_dict(x={"type": "seabed", "dept": 3.0}), "seabed: there is no parameter dept; did you mean depth"),
    (as_dict(**{"3": {3: 4}}), "scene: the key 3 must be a name"),
    (as_dict(x=NESTED), "nested more than 64 deep"),
    (lambda: mitransient_lidar.open("/dev/zero"), "/dev/zero: it is a device"),
)
def test_python_calls(call, folder):
    call()


def test_exhausted_memory_is_one_sentence_and_other_runtime_errors_stay_bugs():
    texts = (MemoryError(), MemoryError("Unable to allocate 7 TiB"), RuntimeError("jit_malloc(): out of memory! ..."))
    for error, kind, sentence in (
        *((one, UserError, r"^memory ran out .*: use fewer bins, pixels or paths_per_pass") for one in texts),
        (RuntimeError("a bug"), RuntimeError, "^a bug$"),
    ):

        def render_pass(number, seed, error=error):
            raise error

        with pytest.raises(kind, match=sentence):
            run_passes(render_pass, Goal(passes=2), seed=0)


@pytest.mark.slow
@each_row(("/etc/passwd", "'/etc/passwd'"), ("/nowhere.so", "is not a file"))
def test_another_library_than_llvm(library, part, tmp_path):
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": library}
    command = [sys.executable, "-m", "mitransient_lidar", "render", "table1", "-o", str(tmp_path / "out")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1].startswith("Dr") or "DRJIT_LIBLLVM_PATH" in done.stderr
    assert part in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
