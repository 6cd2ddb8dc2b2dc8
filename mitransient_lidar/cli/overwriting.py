"""Which existing files a command may replace: its own earlier files for the same scene and instrument.

Every file that a command writes gets a mark (`core.marks`) with the command, its scene, instrument and options.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import os
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar._version import __version__
from mitransient_lidar.core.errors import UserError, WriteError
from mitransient_lidar.core.files import Moves, before_moving
from mitransient_lidar.core.marks import holds_mark, read_mark, write_mark
from mitransient_lidar.core.validation import shown

Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite", help="Replace files of other scenes, instruments, commands and programs, too, but no stores."
    ),
]

_LONG_S = 60.0  #: A file that took longer to make is kept [s].

#: Arguments that are results, whose scene and instrument count, and other arguments that name a command's subject.
_RESULTS = ("file", "stack", "first", "second")
_PLACES, _NAMES = ("scene", "campaign", "flight"), ("instrument", "kind")

#: Options that change no contents, and those that are listed as parameters of the scene.
_SILENT = ("output", "figure", "quiet", "browser", "plot", "table", "define")

_MOST_DIFFERENCES = 8

_running: ContextVar[_Running | None] = ContextVar("running", default=None)


def keeping(command: Callable[..., None]) -> Callable[..., None]:
    """Add the option --overwrite to a command that has an output, and mark the files that it writes."""
    own = inspect.signature(command, eval_str=True)
    if "output" not in own.parameters:
        return command

    @functools.wraps(command)
    def run(*, overwrite: bool, **options: Any) -> None:
        running = _Running(command.__name__.replace("_", "-"), options, overwrite)
        tokens = _running.set(running), before_moving.set(running.settle)
        try:
            command(**options)
        finally:
            _running.reset(tokens[0])
            before_moving.reset(tokens[1])

    every = list(own.parameters.values())
    place = list(own.parameters).index("output") + 1
    every.insert(place, inspect.Parameter("overwrite", every[0].kind, default=False, annotation=Overwrite))
    run.__signature__ = own.replace(parameters=every)  # type: ignore[attr-defined]
    return run


def check_kept(targets: Iterable[Path], option: str = "-o") -> None:
    """Raise `UserError` for a file that the running command may not replace; `option` chooses another place."""
    if (running := _running.get()) is not None:
        running.prepare()
        for target in targets:
            if reason := running.objection(target):
                ways = f"choose another place with {option}, or replace it with --overwrite"
                raise UserError(f"{target} is kept, since {reason}: {ways}")


def replace_freely(targets: Iterable[Path]) -> None:
    """Let the running command replace files that it is known to have written."""
    if (running := _running.get()) is not None:
        running.written.update(targets)


def draws_again(file: Path) -> None:
    """State that the running command draws the result in a file, so that it may replace drawings by ``render``."""
    running, mark = _running.get(), _mark_of_result(file) or {}
    if running is not None and mark.get("command") == "render" and "result" in mark:
        running.mark |= {name: mark[name] for name in ("command", "result", "parameters", "options")}


class _Running:
    """A running command: the marks of its files, and the files that it may replace."""

    def __init__(self, command: str, options: Mapping[str, Any], overwrite: bool) -> None:
        self._given, self._overwrite, self._began = options, overwrite, time.perf_counter()
        self.written: set[Path] = set()
        self._subject: dict[str, str | Path] = {}
        self._former: dict[Path, dict[str, Any]] = {}
        plain = {name: _plain(value) for name, value in options.items() if name not in (*_SILENT, *_PLACES, *_NAMES)}
        self.mark: dict[str, Any] = {"command": command, "release": __version__, "options": plain}
        self.mark["result"] = uuid.uuid4().hex

    def prepare(self) -> None:
        """Read scene and parameters, before the command takes its time."""
        if not self._subject:
            self._subject = self._read_subject()
            self.mark.setdefault("parameters", self._read_parameters())

    def _read_subject(self) -> dict[str, str | Path]:
        """Return scene, instrument and so on, with the paths of those that are files."""
        found: dict[str, str | Path] = {"instrument": ""}
        for name in _RESULTS:
            if isinstance(path := self._given.get(name), Path):
                about = _subject_of_file(path)
                found |= {f"second_{key}": value for key, value in about.items()} if name == "second" else about
        for name in _PLACES:
            if (value := self._given.get(name)) is None:
                continue
            if name == "scene" and _is_result(value):
                found |= _subject_of_file(Path(value))
            elif Path(value).exists() and not _is_shipped(name, str(value)):
                path = Path(value).resolve()
                # A campaign and its store have one name.
                found |= {name: path.stem, f"{name}_file": path.with_suffix("") if name == "campaign" else path}
            else:
                found |= {name: str(value), f"{name}_file": ""}
        found |= {name: str(self._given[name]) for name in _NAMES if self._given.get(name) is not None}
        return found

    def _read_parameters(self) -> dict[str, str]:
        """Return the scene parameters, with defaults."""
        known: dict[str, str] = {}
        scene = self._given.get("scene")
        if scene is not None and _is_result(scene):
            known = (_mark_of_result(Path(scene)) or {}).get("parameters", {})
        elif scene is not None:
            from mitransient_lidar.loading.catalogue import scene_parameters

            known = {name: value for name, value in scene_parameters(scene).items() if value}
        return {**known, **parameters(self._given.get("define"))}

    def objection(self, path: Path) -> str | None:
        """Return why an existing file is kept; None if it may be replaced or does not exist."""
        if self._overwrite or path in self.written or not os.path.lexists(path):
            return None
        return self._objection(path, self._mark_of(path))

    def _objection(self, path: Path, former: Mapping[str, Any] | None) -> str | None:
        if former is None:
            return "no command has written it as it is" if holds_mark(path) else "it does not tell what has written it"
        if former.get("result") == self.mark["result"]:
            return None
        if former["command"] != self.mark["command"]:
            return f"the command {_text(former['command'])} has written it"
        subject, others = self._relative_subject(path), former["subject"]
        if other := [name for name in subject if name in others and subject[name] != others[name]]:
            return f"its {other[0].replace('_', ' ')} is {_text(others[other[0]]) or 'another one'}"
        if former["elapsed_s"] > _LONG_S:
            return f"it took {former['elapsed_s']:.0f} s to make"
        return None

    def _mark_of(self, path: Path) -> dict[str, Any] | None:
        """Return a file's mark, or the mark in the neighbouring file that vouches for it; None for other files."""
        if (former := _mark_of_result(path)) is None:
            vouching = [one for one in self._former.values() if path.name in one["beside"]]
            return next((one for one in vouching if one["beside"][path.name] == _digest(path)), None)
        self._former[path] = former
        return former

    def _relative_subject(self, path: Path) -> dict[str, str]:
        """Return the subject with paths relative to the folder of a file, so that folders can be moved."""
        folder = path.parent.resolve()
        return {
            name: os.path.relpath(value, folder) if isinstance(value, Path) else value
            for name, value in self._subject.items()
        }

    def settle(self, moves: Moves) -> Moves:
        """Mark complete files, report replaced ones, and return their destinations.

        A file that must be kept, and was not there when the command began, keeps its name; the new one gets another.
        """
        self.prepare()
        settled: Moves = []
        for temporary, path in moves:
            reason = self.objection(path)
            settled.append((temporary, _free_name(path) if reason else path))
            if reason:
                _tell(f"{path} is kept, since {reason}: the new file is {settled[-1][1]}.")
        self._announce([path for _, path in settled])
        mark = {**self.mark, "elapsed_s": time.perf_counter() - self._began}
        marked = [path for _, path in settled if holds_mark(path)]
        plain = {path.name: _digest(temporary) for temporary, path in settled if marked and path not in marked}
        for temporary, path in settled:
            if path in marked:
                try:
                    write_mark(temporary, {**mark, "subject": self._relative_subject(path), "beside": plain})
                except OSError as error:
                    raise WriteError(f"cannot write {path}: {error.strerror}") from error
        self.written.update(path for _, path in settled)
        return settled

    def _announce(self, paths: list[Path]) -> None:
        """Print which files are replaced, and the differences."""
        replaced = sorted(
            (path for path in paths if path not in self.written and os.path.lexists(path)),
            key=lambda path: path.suffix.lower() != ".nc",
        )
        if not replaced or self._given.get("quiet"):
            return
        former = {path: self._mark_of(path) for path in replaced}
        reasons = {path: self._objection(path, mark) for path, mark in former.items()}
        first = next(filter(reasons.get, replaced), replaced[0])
        more = f" and {len(replaced) - 1} more" if len(replaced) > 1 else ""
        _tell(f"replaces {first}{more}: {reasons[first] or self._differences(former[first])}")

    def _differences(self, former: Mapping[str, Any] | None) -> str:
        """Return the parameters and options that differ from a former file's."""
        found: list[str] = []
        former = former or {"parameters": None, "options": None}
        for kind in ("parameters", "options"):
            before, now = former[kind], self.mark[kind]
            # Attributes from earlier releases contain no options.
            names = [name for name in {**now, **(before or now)} if before and before.get(name) != now.get(name)]
            found += [f"{_text(name)} {_text(before.get(name))} -> {_text(now.get(name))}" for name in names]
        if len(found) > _MOST_DIFFERENCES:
            found = [*found[:_MOST_DIFFERENCES], f"{len(found) - _MOST_DIFFERENCES} more"]
        return ", ".join(found) or "no option differs"


def parameters(definitions: list[str] | None) -> dict[str, str]:
    """Return scene parameters given as ``name=value``."""
    params = {}
    for definition in definitions or []:
        name, equals, value = definition.partition("=")
        if not (name.strip() and equals):
            raise UserError(f"-D {definition} is not of the form name=value")
        params[name.strip()] = value.strip()
    return params


def _tell(text: str) -> None:
    """Print a line on stderr, unless that is closed: files are written nevertheless."""
    with contextlib.suppress(OSError):
        typer.echo(text, err=True)


def _subject_of_file(path: Path) -> dict[str, str | Path]:
    """Return a result's scene and instrument; another file's own name."""
    if (mark := _mark_of_result(path)) is None:
        return {"scene": path.stem, "scene_file": path.resolve()}
    return {
        name: (path.parent / value).resolve() if name.endswith("_file") and value else str(value)
        for name, value in mark["subject"].items()
    }


def _mark_of_result(path: Path) -> dict[str, Any] | None:
    """Return a file's mark, or the attributes of a result from an earlier release or a script."""
    types = {"command": str, "subject": dict, "parameters": dict, "options": dict, "beside": dict, "elapsed_s": float}
    mark = read_mark(path)
    if mark is not None and all(isinstance(mark.get(name), kind) for name, kind in types.items()):
        return mark
    if not _is_result(path) or not path.is_file():
        return None
    from mitransient_lidar.rendering import again
    from mitransient_lidar.results.files import check_sum

    try:
        if path.suffix.lower() == ".nc" and not check_sum(path):
            return None  # from another program, which may have kept the attributes
        attributes = again.read_attributes(path)
        command = again.result_kind(attributes)
    except UserError:
        return None
    prefix = "scene."
    subject = {name: str(attributes.get(name, "")) for name in ("scene", "instrument")}
    held = {name[len(prefix) :]: str(value) for name, value in attributes.items() if name.startswith(prefix)}
    return {
        "command": command,
        "subject": {**subject, "scene": Path(subject["scene"]).stem},
        "parameters": held,
        "options": None,
        "beside": {},
        "elapsed_s": float(attributes.get("elapsed_s", 0)),
    }


def _is_result(path: str | Path) -> bool:
    return Path(path).suffix.lower() in (".nc", ".exr")


def _is_shipped(name: str, value: str) -> bool:
    if name != "scene":
        return False
    from mitransient_lidar.loading.catalogue import scene_names

    return value in scene_names()


def _digest(path: Path) -> str:
    """Return the SHA-256 of a regular file, empty for others."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _free_name(path: Path) -> Path:
    """Return a name beside a path that no file has."""
    number = 2
    while os.path.lexists(free := path.with_name(f"{path.stem}_{number}{path.suffix}")):
        number += 1
    return free


def _plain(value: Any) -> Any:
    """Return an option's value as JSON types."""
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def _text(value: Any) -> str:
    """Return a mark's value for a message."""
    if value is None:
        return "default"
    return shown(value).strip("'\"")
