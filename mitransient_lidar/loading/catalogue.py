"""Shipped scenes: names, texts, parameters and copies.

A scene is a Mitsuba XML file in ``mitransient_lidar.scenes``; its name is the file name without the suffix. Files
whose names begin with an underscore are parts that scenes include.
"""

from __future__ import annotations

import difflib
import importlib.resources
import os
import shutil
from pathlib import Path

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import check_regular, read_text, replacing, together
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading.document import read_document
from mitransient_lidar.loading.parameters import values_of


def scene_names() -> list[str]:
    """Return the names of the shipped scenes in alphabetical order."""
    return sorted(path.stem for path in folder_of_scenes().glob("*.xml") if not path.name.startswith("_"))


def scene_path(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the path of a shipped scene, which has priority over a file with the same name, or of an XML file.

    Raises UserError if there is no such scene; the message lists shipped scenes with similar names.
    """
    names = scene_names()
    if not isinstance(name_or_path, (str, os.PathLike)):
        raise UserError(f"scene = {shown(name_or_path)} must be the name of a shipped scene or the path of an XML file")
    if str(name_or_path) in names:
        return folder_of_scenes() / f"{name_or_path}.xml"
    path = Path(name_or_path)
    if path.is_dir():
        raise UserError(f"scene {str(name_or_path)!r} is a folder; give an XML file or the name of a shipped scene")
    if path.exists():
        check_regular(path)
        return path
    close = difflib.get_close_matches(path.stem, names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}" if close else f"shipped scenes are {', '.join(names) or 'none'}"
    raise UserError(f"scene {str(name_or_path)!r} is neither a file nor a shipped scene; {hint}")


def scene_text(name: str | os.PathLike[str]) -> str:
    """Return the self-contained XML text of a scene, with included files in place.

    Name as in `scene_path`; format and further errors as in `loading.document`.
    """
    return read_document(scene_path(name)).text


def scene_summary(name: str | os.PathLike[str]) -> str:
    """Return the first line of a scene's first comment, empty without a comment; name and errors as in `scene_path`."""
    comment, end, _ = read_text(scene_path(name)).partition("<!--")[2].partition("-->")
    return comment.strip().partition("\n")[0].strip() if end else ""


def scene_parameters(name: str | os.PathLike[str], *, by_id: bool = False) -> dict[str, str]:
    """Return names and values of a scene's parameters: its own (``<default>`` tags), and its plugins'.

    Values are texts, empty for parameters without one. With `by_id`, plugin parameters have their names with ids, too.
    Name and errors as in `scene_text`.
    """
    return values_of(read_document(scene_path(name)), by_id=by_id)


def example_files() -> dict[str, Path]:
    """Return the files of the guides and the shipped flights, by their names."""
    folders = (folder_of_scenes() / "examples", folder_of_scenes() / "flights")
    return {path.name: path for folder in folders for path in sorted(folder.glob("*.*"))}


def copy_scene(
    name: str | os.PathLike[str], destination: str | os.PathLike[str] = ".", overwrite: bool = False
) -> Path:
    """Write a scene as one self-contained file, with copies of the files in its folder that it names.

    Raises UserError if there is no such scene, a file exists already, or one cannot be read or written. No file is
    written then.

    `name`: as in `scene_path`, or the name of a file in `example_files`. `destination`: folder, or path of the new
    file, which is returned. `overwrite`: whether to replace files.
    """
    source = example_files().get(str(name)) or scene_path(name)
    destination = Path(destination)
    target = destination / source.name if destination.is_dir() else destination
    copies = {target: source, **{target.parent / file.name: file for file in files_named_by(source)}}
    for copy, original in copies.items():
        if copy.exists() and copy.samefile(original):
            raise UserError(f"{copy} is the file to be copied: choose another place")
        if os.path.lexists(copy) and not overwrite:
            raise UserError(f"{copy} exists already: choose another place, or replace it with --overwrite")
    with together():
        for copy, original in copies.items():
            with replacing(copy) as temporary:
                if original.suffix == ".xml":
                    temporary.write_text(read_document(original).text, encoding="utf-8")
                else:
                    shutil.copyfile(original, temporary)
    return target


def files_named_by(source: Path) -> list[Path]:
    """Return the files in the folder of a scene or flight that it names, and those that these name."""
    found, left = [source], [source]
    while left:
        file = left.pop()
        if file.suffix in (".xml", ".toml"):
            text = read_document(file).text if file.suffix == ".xml" else read_text(file)
            near = (one for one in sorted(file.parent.iterdir()) if one.is_file() and one not in found)
            named = [one for one in near if f'"{one.name}"' in text]
            found += named
            left += named
    return found[1:]


def folder_of_scenes() -> Path:
    """Return the folder with the shipped scenes."""
    return Path(str(importlib.resources.files("mitransient_lidar.scenes")))
