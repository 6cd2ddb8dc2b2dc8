"""Properties of waters, their scene parameters, and the command."""

import re
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
from command_line import assert_refused, run
from rows import each_case, each_row
from scipy.integrate import trapezoid

from mitransient_lidar.physics.water import water_types
from mitransient_lidar.physics.water.profiles import read_profile
from mitransient_lidar.physics.water.water_types import water_of
from mitransient_lidar.plots.water import plot_water

STATION = """depth, a, b, bb_ratio
1, 0.1, 0.2, 0.01
4, 0.3, 0.6, 0.04
6, 0.05, 0.1, 0.02
10, 0.05, 0.1, 0.02
"""


@pytest.fixture
def station(tmp_path):
    path = tmp_path / "a station & more.csv"
    path.write_text(STATION)
    return path


def figures(output):
    """Return the printed numbers by name, and those of the -D options."""
    lines = output.splitlines()
    named = {line[:30].strip(): float(line[30:]) for line in lines[:-1] if re.match(r".{30}[0-9.]", line)}
    options = dict(part.split("=") for part in lines[-1].split(" -D ")[1:])
    return named, {name: float(value) for name, value in options.items()}


@each_row(
    ("jerlov II", water_types.jerlov("II")),
    ("chlorophyll 1", water_types.chlorophyll(1.0)),
    ("kd 0.1", water_types.from_kd(0.1)),
    ("secchi 6", water_types.from_secchi(6.0)),
    ("pure", water_types.pure_seawater()),
)
def test_every_kind_is_printed_and_can_be_rendered(arguments, wanted):
    named, options = figures(run("scenes", "water", *arguments.split()).stdout)
    assert named["absorption a (1/m)"] == pytest.approx(wanted.absorption, rel=1e-4)
    assert named["diffuse attenuation Kd (1/m)"] == pytest.approx(wanted.kd, rel=1e-4)
    assert options["attenuation"] == pytest.approx(wanted.absorption + wanted.scattering, rel=1e-5)
    assert options["scattering"] == pytest.approx(wanted.scattering, rel=1e-5)
    assert options["backscattering"] == pytest.approx(wanted.backscattering, rel=1e-5)
    # Quan and Fry at 532 nm, 20 deg C and 35 per mille.
    assert options["refractive_index"] == pytest.approx(1.341510, abs=1e-5)
    assert options["group_index"] == pytest.approx(1.363796, abs=1e-5)


@pytest.mark.slow
@each_case(
    (["mud", "3"], "kind = 'mud' must be one of jerlov"),
    (["jerlov"], "value is missing: jerlov needs one"),
    (["pure", "3"], "value = '3' must be left out"),
    (["kd", "clear"], "value = 'clear' must be a number for kd"),
    (["kd", "0.1", "--wavelength", "500"], "wavelength = 500 must be 532, or 700 to 1100, for kd"),
    (["petzold", "muddy"], "value = 'muddy' must be one of clear, coastal, turbid, autec_7, "),
    (["petzold", "clear", "--wavelength", "600"], "wavelength = 600 must lie between 514 and 533, or above"),
    (["profile", "missing.csv"], "cannot read missing.csv: No such file"),
    (["jerlov", "II", "-o", "a.txt"], "cannot write a.txt: the file name must end in .png, .pdf or .svg"),
    (["pure", "-o", "missing/a.png"], "cannot write missing/a.png: No such file"),
)
def test_mistakes_are_one_sentence(arguments, message):
    assert_refused(run("scenes", "water", *arguments), message)


@each_row(("clear", 0.114, 0.037, 0.044), ("coastal", 0.179, 0.219, 0.013), ("turbid", 0.366, 1.824, 0.020))
def test_petzold_waters(name, a, b, ratio):
    done = run("scenes", "water", "petzold", name)
    assert "measured at 514 to 530 nm" in done.stdout
    named, options = figures(done.stdout)
    assert named["absorption a (1/m)"] == a
    assert named["bb/b"] == pytest.approx(ratio, abs=5.5e-4)
    assert options["attenuation"] == pytest.approx(a + b, rel=1e-6)
    assert options["backscattering"] == pytest.approx(named["bb/b"] * b, rel=1e-4)


def test_profile_is_described(station):
    lines = run("scenes", "water", "profile", station, "--tolerance", "0.05").stdout.splitlines()
    named = {line[:30].strip(): line[30:] for line in lines if re.match(r".{30}[0-9]", line)}
    assert named["depth (m)"] == "1 to 10"
    ends = {"absorption a": "0.05 to 0.3", "scattering b": "0.1 to 0.6", "attenuation c": "0.15 to 0.9"}
    assert {name: named[f"{name} (1/m)"] for name in ends} == ends
    assert named["bb/b"] == "0.01 to 0.04"
    # 0.3 * 1 above the first node, then trapezia: 0.6 * 3 + 0.525 * 2 + 0.15 * 4.
    assert named["optical depth to 10 m"] == "3.75"
    count = int(named["layers within 5 %"])
    # A ratio of 1.1 a layer: c alone has ln 3 and ln 6, bb ln 12 and ln 12 to go through; the last has no end.
    assert count == pytest.approx(2 * np.log(12) / np.log(1.1) + 1, abs=4)
    assert count == read_profile(station).layers(0.05).count


@pytest.mark.slow
def test_profile_line_is_xml_for_a_medium(station):
    """The path in the XML is absolute and complete, with its spaces and signs, and valid in every folder."""
    done = run("scenes", "water", "profile", str(station), "--tolerance", "0.05")
    medium = ElementTree.fromstring(f"<medium>{done.stdout.splitlines()[-1]}</medium>")
    given = {child.get("name"): child.get("value") for child in medium}
    assert given == {"profile": str(station), "profile_tolerance": "0.05"}
    usual = run("scenes", "water", "profile", str(station)).stdout.splitlines()[-1]
    assert "profile_tolerance" not in usual
    for element, tolerance in ((done.stdout.splitlines()[-1], 0.05), (usual, 0.01)):
        loaded = mi.load_string(f'<medium version="3.0.0" type="layered_water">{element}</medium>')
        assert loaded.water.column.count == read_profile(station).layers(tolerance).count


def test_pure_sea_water_renders():
    """No Fournier-Forand function has bb/b = 0.5: without its own scattering the medium would be refused."""
    done = run("scenes", "water", "pure")
    _, options = figures(done.stdout)
    names = ("attenuation", "scattering", "backscattering")
    values = {name: options[name] for name in names}
    water = mi.load_dict({"type": "layered_water", **values, "water_scattering": options["water_scattering"]})
    assert water.water.phases.phases[0].backscatter_ratio == pytest.approx(0.5, rel=1e-4)
    with pytest.raises(RuntimeError, match="backscatter_ratio"):
        mi.load_dict({"type": "layered_water", **values})


@each_row(
    # Zhang, Hu and He (2009): 2.2975e-4 / 0.001962 forwards as backwards.
    ("pure", None, "pure sea water, bb/b = 0.5", 0.5, 0.1171, 1e-3),
    # Petzold's 16.623 over his 0.219 at 1 degree.
    ("petzold", "coastal", "measured, bb/b = 0.0134", 0.0134, 75.9, 0.02),
    # Mobley, Sundman and Boss (2002): n = 1.10 and mu = 3.5835 for particles of 0.0183, whose function is 72.78 at
    # 1 degree; of b = 0.936 molecules scatter 0.00196, a half of it backwards.
    ("secchi", "6", "Fournier-Forand and molecules, bb/b = 0.0193", 0.01931, 72.63, 2e-3),
)
def test_every_kind_draws_its_function(kind, value, label, share, at_1_degree, tolerance, monkeypatch):
    drawn = []
    monkeypatch.setattr("mitransient_lidar.plots.water.plot_phase_function", lambda *arguments: drawn.append(arguments))
    plot_water(kind, value, 532.0, 20.0, 35.0, 0.01, "a.png")
    ((phase, name, title, path),) = drawn
    assert (name, path) == (label, "a.png")
    assert f"a = {water_of(kind, value, 532.0, 20.0, 35.0).absorption:.3g}, " in title
    theta = np.linspace(np.pi / 2, np.pi, 20_001)
    assert 2 * np.pi * trapezoid(phase(theta) * np.sin(theta), theta) == pytest.approx(share, rel=5e-3)
    assert phase(np.radians(1.0)) == pytest.approx(at_1_degree, rel=tolerance)
