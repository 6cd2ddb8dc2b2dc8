"""Versions that decide the numbers of a run: all processes that render into a store must have the same."""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mitransient_lidar._version import __version__
from mitransient_lidar.core.errors import UserError

_LOG = logging.getLogger(__name__)

#: Packages whose version decides the numbers. LLVM does not: 22.1 and 23.1 give the same bits.
_PACKAGES = ("mitsuba", "drjit", "numpy")

_SUFFIXES = (".py", ".csv", ".toml")  #: Files of the package that decide the numbers, by suffix.
FILES = "files of mitransient-lidar"  #: Name of the SHA-256 of the files.


def own_versions() -> dict[str, str]:
    """Return this process's versions by name, and the first digits of the SHA-256 of the package's files.

    An installation from sources keeps its version while its files change.
    """
    return {
        "mitransient-lidar": __version__,
        FILES: _digest(),
        **{name: importlib.metadata.version(name) for name in _PACKAGES},
        "python": ".".join(map(str, sys.version_info[:2])),
    }


def difference(wanted: Mapping[str, str], found: Mapping[str, str]) -> str | None:
    """Return in words which version is found where another one is wanted, None where all are the same."""
    texts: list[str] = []
    for name, version in wanted.items():
        other = found.get(name, "unknown")
        # Another version has other files.
        if other != version and not (name == FILES and texts):
            texts.append(f"{name} {other} instead of {version}")
    return " and ".join(texts) or None


def check_versions(store: Path, attributes: Mapping[str, Any]) -> None:
    """Raise `UserError` if current renders would give other numbers than the versions that a store has.

    Package files that have changed since, as in a source folder, give a warning.
    """
    own = own_versions()
    # Stores from version 0.2 state Mitsuba and Dr.Jit alone.
    first = {name: attributes.get(f"{name}_version", own[name]) for name in ("mitsuba", "drjit")}
    begun = attributes.get("versions", first)
    if differs := difference({**begun, FILES: own[FILES]}, own):
        raise UserError(
            f"{store} was begun by other versions, and here is {differs}: install those, or choose another place"
        )
    if difference(begun, own):
        _LOG.warning("files of this package have changed since %s was begun: numbers may differ", store)


def other_versions(place: str, differs: str) -> str:
    """Return the sentence that refuses a place, as a worker, with other versions."""
    return f"{place} has {differs}: all that render into a store must have the same"


def _digest() -> str:
    """Return the first digits of the SHA-256 of the files, the same for a wheel and for sources.

    Scenes are left out: a store holds its own.
    """
    import mitransient_lidar.plugins

    found = hashlib.sha256()
    for module, others in ((mitransient_lidar, ("plugins", "scenes")), (mitransient_lidar.plugins, ())):
        root = Path(module.__file__ or "").parent
        for path in sorted(root.rglob("*")):
            name = path.relative_to(root)
            if path.suffix in _SUFFIXES and name.parts[0] not in others:
                found.update(f"{name.as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return found.hexdigest()[:12]
