"""What is installed: the wheel holds every plugin and scene, and importing costs little."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    source = tmp_path_factory.mktemp("source") / "project"
    # A clean copy: a build folder of an earlier wheel would hide what the configuration forgets.
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(source)], check=True)
    for name in subprocess.check_output(
        ["git", "-C", str(ROOT), "ls-files", "--modified", "--others", "--exclude-standard"], text=True
    ).split():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run([*command, str(source)], check=True)
    (path,) = folder.glob("*.whl")
    return set(zipfile.ZipFile(path).namelist())


@pytest.mark.slow
def test_wheel_holds_every_module_plugin_scene_and_data_file(wheel):
    expected = set()
    for folder, package in (("mitransient_lidar", ""), ("plugins", "plugins/"), ("scenes", "scenes/")):
        for path in (ROOT / folder).rglob("*"):
            kinds = (".py", ".xml", ".ply", ".csv", ".typed", ".html", ".css", ".js")
            if path.suffix in kinds and "__pycache__" not in path.parts:
                expected.add(f"mitransient_lidar/{package}{path.relative_to(ROOT / folder).as_posix()}")
    assert expected <= wheel
    assert any(name.endswith("licenses/LICENSE") for name in wheel)


def test_every_plugin_file_is_registered():
    from mitransient_lidar.loading import variants

    files = [path.relative_to(ROOT / "plugins").with_suffix("") for path in (ROOT / "plugins").rglob("*.py")]
    assert {".".join(file.parts) for file in files if file.name != "__init__"} == set(variants.PLUGIN_MODULES)


@pytest.mark.slow
def test_import_loads_nothing_heavy():
    """Import stays under a second because these load when they are needed."""
    heavy = "('xarray', 'pandas', 'matplotlib', 'scipy', 'h5py')"
    code = f"import sys, mitransient_lidar; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


@pytest.mark.slow
@pytest.mark.parametrize("command", ["fit"])
def test_help_needs_signatures_alone(command):
    """A third of the time of a help was the import of xarray and pandas, for types that it does not show."""
    code = "import sys; from mitransient_lidar.cli.app import main\ntry: main()\nfinally: print(sorted(sys.modules))"
    shown = subprocess.check_output([sys.executable, "-c", code, command, "--help"], text=True)
    assert "--seed" in shown or command == "echoes"
    assert not [name for name in ("'pandas'", "'xarray.core'", "'h5py'", "'scipy'") if name in shown]


def test_readme_commands_name_what_exists():
    text = (ROOT / "README.md").read_text()
    ci = (ROOT / ".ci" / "run").read_text()
    (command,) = (line for line in text.splitlines() if line.startswith("python3") and "pytest" in line)
    assert command in ci
    assert (ROOT / "docs" / "images" / "table1.png").is_file()
