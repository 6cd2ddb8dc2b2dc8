"""The scenes that come with the package.

A scene is a Mitsuba XML file in ``mitransient_lidar.scenes``; its name is the file's name without the suffix. Files
whose names begin with an underscore are parts of other scenes and have no name of their own.
"""

from __future__ import annotations

import difflib
import importlib.resources
import os
import re
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

from mitransient_lidar.errors import UserError

_COMMENT = re.compile(r"<!--(.*?)-->", re.DOTALL)


def scene_names() -> list[str]:
    """Return the names of the shipped scenes in alphabetical order."""
    return sorted(path.stem for path in _folder().glob("*.xml") if not path.name.startswith("_"))


def scene_path(name_or_path: str | os.PathLike[str]) -> Path:
    """Find a scene.

    Parameters
    ----------
    name_or_path : str or path
        Name of a shipped scene, or path of an XML file. A shipped scene wins over a file of the same name.

    Returns
    -------
    pathlib.Path
        An existing file.

    Raises
    ------
    UserError
        If there is no such scene; the sentence lists shipped scenes of similar names.
    """
    names = scene_names()
    if str(name_or_path) in names:
        return _folder() / f"{name_or_path}.xml"
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.is_dir():
        raise UserError(f"scene {str(name_or_path)!r} is a folder; give an XML file or the name of a shipped scene.")
    close = difflib.get_close_matches(path.stem, names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}" if close else f"shipped scenes are {', '.join(names) or 'none'}"
    raise UserError(f"scene {str(name_or_path)!r} is neither a file nor a shipped scene; {hint}.")


def scene_text(name: str | os.PathLike[str]) -> str:
    """Return the XML text of a scene; name and errors as in `scene_path`."""
    path = scene_path(name)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"scene {path} is not a UTF-8 text file.") from error
    except OSError as error:
        raise UserError(f"cannot read scene {path}: {error.strerror}.") from error


def scene_summary(name: str | os.PathLike[str]) -> str:
    """Return the first line of a scene's first comment, empty without a comment; name and errors as in `scene_path`."""
    comment = _COMMENT.search(scene_text(name))
    lines = comment[1].strip().splitlines() if comment else []
    return lines[0].strip() if lines else ""


def scene_parameters(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return the parameters of a scene, the ``<default>`` tags of its XML.

    Parameters
    ----------
    path : str or path
        As in `scene_path`.

    Returns
    -------
    dict of str to str
        Parameter names and default values, in the order of the file.

    Raises
    ------
    UserError
        If there is no such scene, or it is no well-formed XML.
    """
    try:
        root = ET.fromstring(scene_text(path))
    except ET.ParseError as error:
        raise UserError(f"scene {path} is not well-formed XML: {error}.") from error
    return {tag.get("name", ""): tag.get("value", "") for tag in root.iter("default")}


def copy_scene(name: str | os.PathLike[str], destination: str | os.PathLike[str] = ".") -> Path:
    """Copy a shipped scene, and the files beside it that it refers to, in order to change it.

    Parameters
    ----------
    name : str
        As in `scene_path`.
    destination : path
        Folder to copy into, or the new file's path.

    Returns
    -------
    pathlib.Path
        The copied XML file.

    Raises
    ------
    UserError
        If there is no such scene, a file would be overwritten, or one cannot be written.
    """
    source = scene_path(name)
    destination = Path(destination)
    target = destination / source.name if destination.is_dir() else destination
    copies = {source: target} | {part: target.parent / part.name for part in _parts(source)}
    for copy in copies.values():
        if copy.exists():
            raise UserError(f"{copy} exists already and is not overwritten.")
    try:
        for original, copy in copies.items():
            shutil.copyfile(original, copy)
    except OSError as error:
        raise UserError(f"cannot write {copy}: {error.strerror}.") from error
    return target


def _parts(scene: Path) -> set[Path]:
    """Return the files in a scene's folder that it names, itself or through another one."""
    found: set[Path] = set()
    pending = [scene]
    while pending:
        text = pending.pop().read_text(encoding="utf-8")
        for neighbour in scene.parent.iterdir():
            if neighbour not in found and neighbour != scene and f'"{neighbour.name}"' in text:
                found.add(neighbour)
                if neighbour.suffix == ".xml":
                    pending.append(neighbour)
    return found


def _folder() -> Path:
    """Return the folder of the shipped scenes."""
    return Path(str(importlib.resources.files("mitransient_lidar.scenes")))
