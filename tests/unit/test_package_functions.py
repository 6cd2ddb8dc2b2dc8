"""Functions at the top of the package: signatures, documentation, completion, what they refuse, and dependencies."""

import inspect
import pydoc
import re
import sys
from pathlib import Path

import jedi
import numpy as np
import pytest
import synthetic_shots
import xarray as xr
from dependency_versions import ROOT, requirements
from packaging.utils import canonicalize_name
from planted_faults import FAULTS
from rows import each_case, each_row

import mitransient_lidar
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.results import save

PUBLIC = {name: getattr(mitransient_lidar, name) for name in sorted({*mitransient_lidar.__all__, "open"})}
FUNCTIONS = {name: function for name, function in PUBLIC.items() if inspect.isfunction(function)}

#: Parameters that are a dataset or its path, a scene, or another thing of a kind that a wrong value must not reach.
DATASETS = {"dataset", "result", "found", "stack", "source"}
#: Functions that write files, or read others than datasets.
OF_FILES = ("save", "view_points")
GIVEN = {*DATASETS, "scene", "campaign", "flight", "instrument", "path", "name"}

#: Values of parameters without a default.
NEEDED = {"site": "1:3", "free": ["attenuation"], "fov_mrad": [5]}

#: Those that take what the test gives by mistake, or need other things first.
TAKEN = {("save", "dataset"), ("save", "path"), ("view", "gates"), ("depth_image", "gates"), ("fit", "instrument")}


def parameters(name):
    return inspect.signature(FUNCTIONS[name]).parameters


def gates():
    coords = {"gate": [0, 1], "gate_start": ("gate", [1.0, 2.0]), "gate_width": ("gate", [1.0, 1.0]), "pixel": ["a"]}
    coords |= {"angle_x": ("pixel", [0.0]), "angle_y": ("pixel", [0.0])}
    energy = ("pixel", "gate"), np.ones((1, 2))
    return xr.Dataset({"gate_energy": energy, "gate_energy_stderr": energy}, coords)


@each_row(*PUBLIC)
def test_every_name_is_documented(name):
    assert name in dir(mitransient_lidar)
    if name in FUNCTIONS:
        assert not any(one.kind is one.VAR_KEYWORD for one in parameters(name).values() if name != "render")
        text = inspect.getdoc(FUNCTIONS[name])
        # A sentence, and what each parameter is.
        assert len(text) > 40
        missing = [one for one in parameters(name) if one != "others" and one not in text]
        assert missing == []
        assert pydoc.plain(pydoc.render_doc(FUNCTIONS[name]))


# Images by daylight have no laser, which an instrument replaces.
@each_row(*zip([one for one in FUNCTIONS if "scene" in parameters(one) and one != "render_passive"]))
def test_parameters_and_an_instrument_go_with_every_scene(name):
    assert {"params", "instrument"} < {*parameters(name)}


def test_a_star_import_leaves_open_alone():
    names = {}
    exec("from mitransient_lidar import *", names)
    assert names["open"] is open if "open" in names else "save" in names
    assert {"render", "GateTrain", "SURVEY_ORDERS"} < set(names)


@each_row(*[(name, one) for name in FUNCTIONS for one in parameters(name) if one in GIVEN and name != "figures"])
@each_row("missing.nc", Path("missing.nc"), None, 3, "gates", "other")
def test_what_is_given_by_mistake_is_refused_in_a_sentence(value, name, given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    is_default = value is None and parameters(name)[given].default is None
    if is_default or {(name, given), (name, value if isinstance(value, str) else "")} & TAKEN:
        pytest.skip("right, or tested elsewhere")
    if value in ("gates", "other"):
        value = gates() if value == "gates" else xr.Dataset({"a": ("x", [1.0])})
    needed = {
        one: NEEDED.get(one, {"store": tmp_path / "a", "folder": tmp_path / "a"}.get(one))
        for one, about in parameters(name).items()
        if about.default is about.empty and one != given and about.kind is not about.VAR_KEYWORD
    }
    if name == "fit":
        needed["free"] = NEEDED["free"]
    if "scene" in needed:
        needed["scene"] = "table1"
    if "instrument" in needed:
        needed["instrument"] = "riegl_vq840g"
    with pytest.raises(UserError) as caught:
        FUNCTIONS[name](**{**needed, given: value})
    sentence = str(caught.value)
    assert "\n" not in sentence
    alike = {"name": "scene|instrument", "scene": "scene|dataset"}.get(given, given).split("|")
    assert any(one in sentence for one in alike) or "missing.nc" in sentence
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@each_case(*zip([name for name in FUNCTIONS if DATASETS & {*parameters(name)} and name not in OF_FILES]))
def test_a_path_gives_what_its_dataset_gives(name, tmp_path):
    shots = synthetic_shots.result()
    if name == "correct_depths":
        shots = mitransient_lidar.echoes(shots.assign_attrs(instrument="riegl_vq840g", **{"scene.wind_speed": "3"}))
    given = next(one for one in parameters(name) if one in DATASETS)
    options = {}
    if name in ("cut_gates", "depth_image"):
        train = mitransient_lidar.GateTrain(float(shots["time"][40]), 5.0, 5.0, 3)
        options = {"train": train} if name == "cut_gates" else {}
        shots = shots if name == "cut_gates" else mitransient_lidar.cut_gates(shots, train)
    if name == "fit":
        options = {"free": ["attenuation"], "scene": "missing.xml"}
    if name == "correct_depths":
        options = {"table": "auto"}
    save(shots, tmp_path / "a.nc")

    def outcome(value):
        try:
            found = FUNCTIONS[name](**{given: value}, **options)
        except UserError as error:
            return str(error)
        if isinstance(found, xr.Dataset):
            return found.drop_attrs().to_dict()
        return found.page if name == "view" else [np.asarray(one).tolist() for one in found]

    one, other = outcome(shots), outcome(tmp_path / "a.nc")
    assert str(one) == str(other)


@pytest.mark.slow
def test_pixels_are_chosen_by_name_in_every_dataset(tmp_path):
    shots = synthetic_shots.result()
    shots["waveform"] = abs(shots["waveform"])
    name = str(shots["pixel"].values[0])
    recorded = mitransient_lidar.record(shots, "apd", shots=2)
    echoes = mitransient_lidar.echoes(recorded)
    cut = mitransient_lidar.cut_gates(shots, mitransient_lidar.GateTrain(float(shots["time"][40]), 5.0, 5.0, 3))
    for number, dataset in enumerate((shots, recorded, echoes, cut)):
        assert dataset.sel(pixel=name)["angle_x"].ndim == 0
        mitransient_lidar.save(dataset, tmp_path / f"{number}.nc")
        assert mitransient_lidar.open(tmp_path / f"{number}.nc").sel(pixel=name)["angle_x"].ndim == 0


def test_citations_name_the_version():
    root, version = Path(__file__).parents[2], mitransient_lidar.__version__
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text("utf-8")
    cited = (root / "docs" / "cite.md").read_text("utf-8")
    assert f"version {version}." in cited
    assert f"version = {{{version}}}" in cited


def test_unknown_functions_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        _ = mitransient_lidar.rendr


@pytest.mark.slow
def test_a_language_server_completes_options():
    for call, wanted in (("render('table1', targ", "target_error="), ("record(shot, opt", "optical_density=")):
        source = f"import mitransient_lidar\nshot = None\nmitransient_lidar.{call}"
        names = [one.name_with_symbols for one in jedi.Script(source).complete()]
        assert wanted in names


def test_open_reads_signals_of_a_receiver(tmp_path):
    time = xr.DataArray(np.arange(40) + 0.5, dims="time")
    waveform = xr.DataArray(np.full((2, 40), 1e-7), dims=("pixel", "time"), coords={"time": time, "pixel": ["a", "b"]})
    attributes = {"time_start_ns": 0.0, "bin_width_ns": 1.0}
    recorded = detect_waveforms(xr.Dataset({"waveform": waveform}, attrs=attributes), "apd", shots=3)
    save(recorded, tmp_path / "signals.nc")
    found = mitransient_lidar.open(tmp_path / "signals.nc")
    np.testing.assert_allclose(found["signal"], recorded["signal"], rtol=1e-6)


def test_former_names_are_refused_with_the_new_one():
    for old, new in mitransient_lidar._FORMER.items():
        with pytest.raises(AttributeError, match=re.escape(f"mitransient_lidar.{old} is now {new}")):
            getattr(mitransient_lidar, old)


#: Packages by their modules, where the names differ.
PACKAGES = {"PIL": "pillow"}

#: Dependencies that no file imports: a shared library, what builds the wheel in a test, and a plugin of pytest.
NOT_IMPORTED = {"karellen-llvm-core", "setuptools", "pytest-xdist"}

#: Packages that tests import where they are installed: of tests with a browser, and a second reader of LAS files.
OPTIONAL = {"selenium", "lazpy"}


#: A line that imports, which takes a tenth of the time of a syntax tree to find.
IMPORT = re.compile(r"^ *(?:import (?=[\w.]+(?: as \w+)?$)|from (?=[\w.]+ import ))(\w+)", re.MULTILINE)


def declared(*extras):
    """Return the names of the dependencies and of those of extras, as package indices normalise them."""
    return {canonicalize_name(requirement.name) for requirement in requirements(*extras)}


def imported(*folders):
    """Return the names of the packages whose modules the Python files of folders import, at any depth of the code."""
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    own = {"mitransient_lidar", *(path.stem for path in (ROOT / "tests").iterdir())}
    names = {name for file in files for name in IMPORT.findall(file.read_text("utf-8"))} - own - sys.stdlib_module_names
    return {canonicalize_name(PACKAGES.get(name, name)) for name in names}


def test_the_package_imports_what_it_declares_and_nothing_else():
    """The scripts among the example files of `scenes` name what they need besides."""
    assert imported("mitransient_lidar", "plugins") == declared("movie") - NOT_IMPORTED


def test_the_tests_import_what_their_extra_declares_and_nothing_else():
    found = imported("tests")
    assert found <= declared("movie", "test") | OPTIONAL
    assert declared("test") - declared() - found - declared("movie") == NOT_IMPORTED - declared()


def test_planted_faults_are_where_their_code_is():
    """Those of a code that has moved would plant nothing."""
    for fault in FAULTS:
        assert (ROOT / fault.file).read_text("utf-8").count(fault.old) == fault.count, fault.name
