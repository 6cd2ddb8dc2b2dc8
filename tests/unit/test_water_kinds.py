"""The command that tells what a way of knowing a water stands for."""

import re

import pytest
from typer.testing import CliRunner

from mitransient_lidar.cli import app
from mitransient_lidar.optics import known_waters

RUN = CliRunner().invoke


def figures(output):
    """Return the printed numbers by name, and those of the -D options."""
    lines = output.splitlines()
    named = {line[:30].strip(): float(line[30:]) for line in lines[:-1] if re.match(r".{30}[0-9.]", line)}
    options = dict(part.split("=") for part in lines[-1].split(" -D ")[1:])
    return named, {name: float(value) for name, value in options.items()}


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["jerlov", "II"], known_waters.jerlov("II")),
        (["chlorophyll", "1"], known_waters.chlorophyll(1.0)),
        (["kd", "0.1"], known_waters.from_kd(0.1)),
        (["secchi", "6"], known_waters.from_secchi(6.0)),
        (["pure"], known_waters.pure_seawater()),
    ],
)
def test_every_kind_is_printed_and_can_be_rendered(arguments, wanted):
    done = RUN(app, ["water", *arguments])
    assert done.exit_code == 0, done.output
    named, options = figures(done.stdout)
    assert named["absorption a (1/m)"] == pytest.approx(wanted.absorption, rel=1e-4)
    assert named["diffuse attenuation Kd (1/m)"] == pytest.approx(wanted.kd, rel=1e-4)
    assert options["attenuation"] == pytest.approx(wanted.absorption + wanted.scattering, rel=1e-5)
    assert options["scattering"] == pytest.approx(wanted.scattering, rel=1e-5)
    assert options["backscattering"] == pytest.approx(wanted.backscattering, rel=1e-5)
    # Quan and Fry at 532 nm, 20 deg C and 35 per mille.
    assert options["refractive_index"] == pytest.approx(1.341510, abs=1e-5)
    assert options["group_index"] == pytest.approx(1.363796, abs=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mud", "3"], "kind = 'mud' must be one of jerlov"),
        (["jerlov"], "value is missing: jerlov needs one"),
        (["pure", "3"], "value = '3' must be left out"),
        (["kd", "clear"], "value = 'clear' must be a number for kd"),
        (["kd", "0.1", "--wavelength", "500"], "wavelength = 500 must be 532 nm for kd"),
        (["jerlov", "IV"], "IV"),
        (["secchi", "100"], "100"),
        (["pure", "--temperature", "80"], "temperature = 80"),
    ],
)
def test_mistakes_are_one_sentence(arguments, message):
    done = RUN(app, ["water", *arguments])
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""
