"""Commands of README, start page and guides: their options exist, and files that they read are shipped or written."""

import ast
import functools
import importlib.util
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from command_line import GROUP, run
from rows import each_row

from mitransient_lidar.loading import catalogue

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", ROOT / "docs" / "start.md", *sorted((ROOT / "docs").glob("guide/*.md"))]
PAGES += sorted((ROOT / "docs").glob("accuracy/*.md"))


def commands(page: Path) -> list[list[str]]:
    """Return the arguments of each command of the program on a page, in order, with shell variables in place."""
    text = page.read_text("utf-8")
    blocks = re.findall(r"^ *```(?:sh|bash|console)\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)
    script = "\n".join(blocks).replace("\\\n", " ")
    values = dict(re.findall(r'^(\w+)="(.*?)"$', script, re.MULTILINE | re.DOTALL)) | {"name": "riegl_vq840g"}
    script = re.sub(r'^\w+=".*?"$', "", script, flags=re.MULTILINE | re.DOTALL)
    for name, value in values.items():
        script = script.replace(f"${name}", " ".join(value.split()))
    lines = [part for line in script.splitlines() if "$(" not in line for part in line.split(" && ")]
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] for line in words if line and Path(line[0]).name == "mitransient-lidar"]


def parsed(arguments: list[str]) -> dict[str, Any]:
    """Parse the arguments of a command as the command line does, without running it, and return their values."""
    command, name = GROUP, ""
    while hasattr(command, "commands"):
        name, *arguments = arguments
        command = command.commands[name]
    return command.make_context(name, arguments).params


@functools.cache
def parameters(scene: str) -> set[str]:
    """Return the names of the parameters of a shipped scene, or of one among the example files."""
    return set(catalogue.scene_parameters(catalogue.example_files().get(scene, scene), by_id=True))


@each_row(*zip([page for page in PAGES if commands(page)]))
def test_commands_options_and_parameters_exist(page: Path) -> None:
    for arguments in commands(page):
        text = " ".join(arguments)
        try:
            values = parsed(arguments[: arguments.index(">")] if ">" in arguments else arguments)
        except Exception as error:
            pytest.fail(f"{text}: {error!r}")
        names = {word.partition("=")[0] for word in values.get("define") or ()}
        if "scene" in values and names and not values["instrument"]:
            unknown = names - parameters(Path(values["scene"]).name)
            assert not unknown, f"{text}: {unknown}"


@each_row(*zip([page for page in PAGES if commands(page)]))
def test_files_that_commands_read_are_shipped_or_written(page: Path) -> None:
    made: set[str] = set()
    for arguments in commands(page):
        files = {word for word in arguments if re.search(r"\.(xml|toml|csv|ply)$", word)}
        if arguments[:2] == ["scenes", "copy"]:
            assert arguments[2] in {*catalogue.example_files(), *catalogue.scene_names()}, arguments
            if source := catalogue.example_files().get(arguments[2]):
                files |= {path.name for path in catalogue.files_named_by(source)}
        elif ">" not in arguments:
            missing = files - made - {arguments[i + 1] for i, word in enumerate(arguments) if word == "--csv"}
            assert not missing, f"{' '.join(arguments)} reads {missing}"
        made |= files


def test_the_guides_list_the_example_files() -> None:
    section = (ROOT / "docs" / "guide" / "index.md").read_text("utf-8").partition("## Files of the guides")[2]
    names = set(re.findall(r"`([\w]+\.\w+)`", section))
    assert names == set(catalogue.example_files())


def test_names_that_example_scripts_import_exist() -> None:
    for script in (path for name, path in catalogue.example_files().items() if name.endswith(".py")):
        for node in ast.walk(ast.parse(script.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("mitransient_lidar"):
                module = importlib.import_module(str(node.module))
                missing = [one.name for one in node.names if not hasattr(module, one.name)]
                # Modules that nothing has imported yet.
                missing = [name for name in missing if not importlib.util.find_spec(f"{node.module}.{name}")]
                assert missing == [], script.name


def test_example_files_are_those_of_the_text() -> None:
    for page, names in {
        "campaigns": ["bottoms.toml"],
        "shore": ["shore.toml"],
        "instruments": ["own_receiver.toml", "detector_effects.toml", "own_camera.toml"],
    }.items():
        text = (ROOT / "docs" / "guide" / f"{page}.md").read_text("utf-8")
        blocks = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
        assert blocks[: len(names)] == [catalogue.example_files()[name].read_text("utf-8") for name in names]


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", pytest.param("docs/guide/gated_cameras.md", marks=pytest.mark.long)])
def test_commands_run_in_order(page, tmp_path, monkeypatch) -> None:
    """With two passes and few pixels: every command finds its files, and replaces none of an earlier one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", lambda *_: True)
    for arguments in commands(ROOT / page):
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
        few = ["--passes", "2"] if arguments[0] == "render" else []
        few += ["-D", "layout=8x8"] if arguments[1] == "gated_mine" else []
        # The first line installs the package, and renders what the others use.
        done = run(*arguments, *few)
        assert done.exit_code == 0, f"{arguments}: {done.output}"
        assert [path for path, time in before.items() if path.stat().st_mtime_ns != time] == [], arguments
