"""Phase functions from files: sampled closed forms, and rejected files."""

from importlib import resources

import numpy as np
import pytest
from oracles.phase import henyey_greenstein
from rows import refuses

from mitransient_lidar.physics.water.phase import henyey_greenstein_backscatter_ratio, petzold_average_particle
from mitransient_lidar.physics.water.phase_table import PowerLawTable, read_phase_table


def uneven_angles():
    """150 angles [deg] from 0.05 to 180, with gaps of 2 to 10 % of the angle."""
    gaps = np.random.default_rng(11).uniform(0.2, 1, 149)
    return np.minimum(0.05 * 3600 ** np.append(0, np.cumsum(gaps) / gaps.sum()), 180)


def write(path, degrees, values, separator=","):
    path.write_text("\n".join(f"{d!r}{separator}{v!r}" for d, v in zip(degrees.tolist(), values.tolist(), strict=True)))
    return path


@pytest.mark.parametrize("g", [0.5, 0.85, 0.95])
def test_henyey_greenstein_at_uneven_angles(tmp_path, g):
    """Values taken as per degree, or integrated without the sine, would be off by far."""
    degrees = uneven_angles()
    path = write(tmp_path / "hg.csv", degrees, henyey_greenstein(np.radians(degrees), g))
    table, integral = read_phase_table(path)
    theta = np.radians(np.geomspace(0.001, 180, 2000))
    np.testing.assert_allclose(table.eval(theta), henyey_greenstein(theta, g), rtol=1e-2)
    assert table.mean_cosine == pytest.approx(g, abs=1e-3)
    assert table.backscatter_ratio == pytest.approx(henyey_greenstein_backscatter_ratio(g), rel=3e-3)
    assert integral == pytest.approx(1, abs=3e-3)


@pytest.mark.parametrize(("power", "core"), [(-1.5, [10**3, 10**1.5, 1]), (0.5, [1, 1, 1])])
def test_towards_zero_a_power_goes_on_or_ends_flat(tmp_path, power, core):
    degrees = np.geomspace(0.5, 180, 30)
    table, _ = read_phase_table(write(tmp_path / "power.txt", degrees, degrees**power, " "))
    found = table.eval(np.radians([0.001, 0.01, 0.1]))
    np.testing.assert_allclose(found / found[-1], core, rtol=1e-3)


def test_angles_in_rad(tmp_path):
    degrees = uneven_angles()
    values = henyey_greenstein(np.radians(degrees), 0.9)
    expected = read_phase_table(write(tmp_path / "degrees.csv", degrees, values))
    path = write(tmp_path / "rad.csv", np.radians(degrees), values)
    path.write_text("theta [rad], vsf [1/sr]\n" + path.read_text())
    np.testing.assert_allclose(read_phase_table(path).table.value, expected.table.value, rtol=1e-9)


@pytest.mark.parametrize("factor", [3.0, 4 * np.pi, 0.15])
def test_factor_of_unnormalised_values(tmp_path, factor):
    degrees = uneven_angles()
    values = henyey_greenstein(np.radians(degrees), 0.9)
    expected = read_phase_table(write(tmp_path / "one.csv", degrees, values))
    read = read_phase_table(write(tmp_path / "many.csv", degrees, factor * values))
    assert read.integral == pytest.approx(factor * expected.integral, rel=1e-12)
    assert read.integral == pytest.approx(factor, rel=5e-3)
    np.testing.assert_allclose(read.table.value, expected.table.value, rtol=1e-12)


def test_petzold_file_equals_the_shipped_table():
    """The file integrates to 0.9929; its first two angles give the power -1.345, the paper's is -1.346."""
    path = resources.files("mitransient_lidar.physics.water").joinpath("petzold_average_particle.csv")
    table, integral = read_phase_table(path)
    assert integral == pytest.approx(0.9929, abs=1e-4)
    theta = np.radians(np.geomspace(0.001, 180, 500))
    # Kinks at the rows: the nodes of the fine table do not coincide with them.
    np.testing.assert_allclose(table.eval(theta), petzold_average_particle()(theta), rtol=1e-2)
    shipped = PowerLawTable.from_function(petzold_average_particle(), table.count)
    assert table.mean_cosine == pytest.approx(shipped.mean_cosine, abs=1e-5)
    assert table.backscatter_ratio == pytest.approx(shipped.backscatter_ratio, rel=1e-4)


def test_an_angle_of_zero_is_used(tmp_path):
    """Between 0 and the next angle ln p is linear in theta^2: half-way a quarter of the drop."""
    degrees = np.array([0.0, *np.linspace(5, 180, 36)])
    values = np.array([8.0, *np.geomspace(2, 0.01, 36)])
    table, integral = read_phase_table(write(tmp_path / "zero.txt", degrees, values, "  "))
    read = table.eval(np.radians([0.001, 2.5, 5.0])) * integral
    np.testing.assert_allclose(read, [8, 8 / 4**0.25, 2], rtol=1e-3)


def test_last_value_is_continued_to_180_degrees(tmp_path):
    degrees = np.linspace(1, 170, 60)
    table, integral = read_phase_table(write(tmp_path / "short.txt", degrees, 2 - degrees / 180, " "))
    read = table.eval(np.radians([168.0, 171.0, 175.0, 180.0])) * integral
    np.testing.assert_allclose(read, 2 - np.array([168, 170, 170, 170]) / 180, rtol=1e-3)


GOOD = [f"{angle} 1" for angle in range(10, 190, 10)]


@refuses(
    ([], "phase.txt has 0 angles but must have at least 10"),
    (GOOD[-9:], "has 9 angles but must have at least 10"),
    (GOOD[:-2], "ends at 160 degrees but its last angle must be at least 170"),
    (["# x", *GOOD[:3], "inf 1", *GOOD[4:]], "phase.txt, line 5: angle = inf must lie between 0 and 180 degrees"),
    ([*GOOD[:3], "40 inf", *GOOD[4:]], "line 4: value = inf must be finite and greater than 0"),
    ([*GOOD[:3], "40 0", *GOOD[4:]], "line 4: value = 0 must be finite and greater than 0"),
    (["-1 1", *GOOD], "line 1: angle = -1 must lie between 0 and 180 degrees"),
    ([*GOOD, "181 1"], "line 19: angle = 181 must lie between 0 and 180 degrees"),
    ([*GOOD[:3], "", "30 1", *GOOD[3:]], "line 5: angle = 30 follows 30 but angles must increase"),
    ([*GOOD, "1 2 3"], "line 19: '1 2 3' must be two numbers, angle in degrees and value"),
    ([*GOOD, "high low"], "line 19: 'high low' must be two numbers"),
    (["8 1.9", *GOOD], r"rises as theta\^-2.88 from 10 to 8 degrees, but the power must be above -2"),
)
def test_invalid_tables_are_rejected(lines, tmp_path):
    path = tmp_path / "phase.txt"
    path.write_text("\n".join(lines))
    read_phase_table(path)
