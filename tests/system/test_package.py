"""What is installed: the wheel holds every plugin and scene, and importing costs little."""

import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from rows import each_case

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    source = tmp_path_factory.mktemp("source") / "project"
    # A clean copy: a build folder of an earlier wheel would hide what the configuration forgets. The site may be built
    # meanwhile.
    others = ".*", "build", "dist", "docs", "site", "*.egg-info", "*.nc"
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*others))
    for path in (ROOT / "scenes" / "instruments").glob("*.nc"):
        shutil.copy(path, source / "scenes" / "instruments")
    (source / "mitransient_lidar" / "commit.txt").write_text("0123456789ab\n")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run([*command, str(source)], check=True)
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as found:
        return {name: found.read(name) for name in found.namelist()}


@pytest.mark.slow
def test_wheel_holds_every_module_plugin_scene_and_data_file(wheel):
    expected = set()
    for folder, package in (("mitransient_lidar", ""), ("plugins", "plugins/"), ("scenes", "scenes/")):
        for path in (ROOT / folder).rglob("*"):
            kinds = (".py", ".xml", ".ply", ".csv", ".typed", ".html", ".css", ".js", ".toml", ".tif")
            if path.suffix in kinds and "__pycache__" not in path.parts:
                expected.add(f"mitransient_lidar/{package}{path.relative_to(ROOT / folder).as_posix()}")
    assert expected <= set(wheel)
    assert any(name.endswith("licenses/LICENSE") for name in wheel)
    assert wheel["mitransient_lidar/commit.txt"] == b"0123456789ab\n"


@pytest.mark.slow
def test_links_of_the_description_are_addresses(wheel):
    """On an index page links to files of the repository would be dead."""
    (description,) = (text.decode() for name, text in wheel.items() if name.endswith("METADATA"))
    targets = re.findall(r"\]\(([^)]*)", description)
    assert targets
    assert [target for target in targets if not target.startswith("https://")] == []
    assert "A simulator of airborne laser bathymetry" in description


def test_the_commit_is_that_of_the_checkout_or_of_the_build(tmp_path):
    def commit():
        return runpy.run_path(str(module))["commit"]()

    def git(*arguments):
        command = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *arguments]
        return subprocess.check_output(command, text=True).strip()

    module = tmp_path / "package" / "_version.py"
    module.parent.mkdir()
    shutil.copy(ROOT / "mitransient_lidar" / "_version.py", module)
    assert commit() == ""
    git("init", "--quiet")
    git("add", "package")
    git("commit", "--quiet", "--message", "one")
    head = git("rev-parse", "HEAD")[:12]
    assert commit() == head
    module.write_text(module.read_text() + "\n")
    assert commit() == f"{head}-dirty"
    (module.parent / "commit.txt").write_text("0123456789ab\n")
    assert commit() == "0123456789ab"


def test_every_plugin_file_is_registered():
    from mitransient_lidar.loading import variants

    files = {path.stem for path in (ROOT / "plugins").rglob("*.py")} - {"__init__", "bases"}
    assert files == {module for module, _ in variants.PLUGIN_MODULES.values()}


@pytest.mark.slow
@each_case(
    ("sys", "mitransient_lidar", "xarray pandas matplotlib scipy h5py"),
    ("mitransient_lidar", "mitransient_lidar.cli.app", "mitsuba xarray matplotlib OpenEXR scipy numpy rich"),
)
def test_imports_load_nothing_heavy(first, then, heavy):
    """Import stays under a second because these load when they are needed."""
    code = f"import sys, {first}; before = {{*sys.modules}}; import {then}; print(*({{*sys.modules}} - before))"
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert not {name.partition(".")[0] for name in loaded.split()} & set(heavy.split())


@pytest.mark.slow
def test_help_needs_signatures_alone():
    """A third of the time of a help was the import of xarray and pandas, for types that it does not show."""
    code = "import sys; from mitransient_lidar.cli.app import main\ntry: main()\nfinally: print(sorted(sys.modules))"
    shown = subprocess.check_output([sys.executable, "-c", code, "fit", "--help"], text=True)
    assert "--seed" in shown
    assert not [name for name in ("'pandas'", "'xarray.core'", "'h5py'", "'scipy'") if name in shown]


def test_readme_commands_name_what_exists():
    text = (ROOT / "README.md").read_text()
    ci = (ROOT / ".ci" / "run").read_text()
    (command,) = (line for line in text.splitlines() if line.startswith("python3") and "pytest" in line)
    assert command in ci
    assert (ROOT / "docs" / "images" / "table1.png").is_file()
