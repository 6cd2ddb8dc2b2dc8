"""The commands that tell of orders of scattering and of a target, as their user runs them."""

import pytest
from typer.testing import CliRunner

from mitransient_lidar.cli import app

NEAR = ["-D", "surface_extent=60", "-D", "bin_width_ns=2", "-D", "bin_count=85"]


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_orders(tmp_path):
    plot = tmp_path / "new" / "orders.png"
    done = run("orders", "fig09_2x2", *NEAR, "--orders", 3, "--passes", 2, "-o", plot, "-q")
    lines = done.stdout.splitlines()
    assert done.exit_code == 0, done.stderr
    assert lines[:2] == [str(plot), str(plot.with_suffix(".nc"))]
    assert [line.split()[0] for line in lines[3:]] == ["0", "1", "2", ">=3", "all"]
    assert sum(float(line.split()[4]) for line in lines[3:-1]) == pytest.approx(100, abs=0.01)
    assert plot.stat().st_size > 20_000
    assert plot.with_suffix(".nc").is_file()


def test_target(tmp_path):
    plot = tmp_path / "target.png"
    done = run("target", "fig13_2x2", *NEAR, "--passes", 16, "-o", plot, "-q")
    assert done.exit_code == 0, done.stderr
    assert done.stdout.splitlines()[:2] == [str(plot), str(plot.with_suffix(".nc"))]
    assert plot.stat().st_size > 20_000


def test_target_on_a_grid(tmp_path):
    plot = tmp_path / "map.png"
    done = run("target", "fig13_2x2", *NEAR, "--passes", 16, "--grid", 2, "--reach", 1, "-o", plot, "-q")
    assert done.exit_code == 0, done.stderr
    assert len(done.stdout.splitlines()) == 2 + 1 + 4
    assert plot.stat().st_size > 20_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("orders", "fig09_2x2", "--orders", 63), "--orders 63 is out of range"),
        (("orders", "fig09_2x2", "-o", "a.txt"), "must end in .png"),
        (("target", "fig13_2x2", "--passes", 2), "--passes 2 is out of range: it must be 16 to 100000"),
        (("target", "fig13_2x2", "--grid", 0), "--grid 0 is out of range"),
        (("target", "fig09_2x2", "-q"), "target = 'target' must be the id of a shape of the scene: surface, bottom"),
    ],
)
def test_mistakes_end_with_one_sentence(arguments, message):
    done = run(*arguments)
    assert (done.exit_code, done.stdout) == (2, "")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
