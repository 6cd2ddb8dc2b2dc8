"""Commands made from the signatures of public functions, whose modules are imported when a command is used."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer
from typer.core import TyperCommand

from mitransient_lidar.cli.messages import reporting, silenced
from mitransient_lidar.cli.overwriting import keeping, parameters
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, declared
from mitransient_lidar.core.validation import finite, number_list

Define = Annotated[
    list[str] | None,
    typer.Option("-D", "--define", metavar="NAME=VALUE", help="Set a scene parameter. Repeatable."),
]
DrawingOnly = Annotated[Path | None, Option("PNG, PDF or SVG file to write")]
OUTPUT = Path("output")  #: Default folder for rendered files.
#: Options of commands that read full-waveform files of lidars (`waveform_selection`).
Waveforms = Annotated[
    str | None,
    Option(
        "Waveforms of a LAS or LAZ file, pulses of a PulseWaves file: from number FIRST, from 0, to before END",
        form="FIRST:END",
    ),
]
Channel = Annotated[
    str | None,
    Option("Channel of such a file: a scanner channel, or the value of a FIELD of its points", form="[FIELD=]N"),
]
Lidar = Annotated[
    list[str] | None,
    Option(
        "What such a file does not state: pulse_fwhm_ns, altitude above the sea [m], sea_level in the file's "
        "heights [m], refractive_index, ... Repeatable",
        form="NAME=VALUE",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only results and errors.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


def print_json(values: Any) -> None:
    """Print values as JSON, and numbers that are not finite as null."""
    text = json.dumps(values, default=lambda array: array.tolist())
    typer.echo(json.dumps(json.loads(text, parse_constant=lambda _: None), indent=2, ensure_ascii=False))


def waveform_selection(
    file: Path, waveforms: str | None, channel: str | None, lidar: list[str] | None
) -> dict[str, Any]:
    """Return the arguments of `results.waveform_files.waveform_chunks`; empty for files of other kinds."""
    given = {"--waveforms": waveforms, "--channel": channel, "--lidar": lidar}
    if file.suffix.lower() not in (".las", ".laz", ".pls", ".wvs"):
        if named := [name for name, value in given.items() if value]:
            raise UserError(f"{named[0]} is for LAS, LAZ and PulseWaves files, and {file} is none")
        return {}
    limits = None
    if waveforms is not None:
        ends = [end.strip() for end in waveforms.split(":")]
        if len(ends) != 2 or not all(end.isdecimal() or not end for end in ends):
            raise UserError(f"--waveforms {waveforms} is not of the form FIRST:END")
        limits = int(ends[0] or 0), int(ends[1]) if ends[1] else None
    known = dict(name_and_value("--lidar", text) for text in lidar or [])
    return {"waveforms": limits, "channel": channel, "lidar": known}


def numbers(option: str, text: str) -> list[float]:
    """Return finite numbers separated by commas."""
    return [float(number) for number in number_list(option, text)]


def pair(option: str, text: str) -> tuple[float, float]:
    """Return two finite numbers separated by a comma."""
    values = numbers(option, text)
    if len(values) != 2:
        raise UserError(f"{option} = {text!r} must be two numbers, as in 2,5")
    return values[0], values[1]


def names(option: str, text: str) -> list[str]:
    """Return names separated by commas."""
    found = [name.strip() for name in text.split(",")]
    if not all(found):
        raise UserError(f"{option} = {text!r} has an empty entry: it must be names separated by commas")
    return found


def number_or_auto(option: str, text: str) -> float | str:
    """Return a finite number, or the word auto."""
    try:
        return text if text == "auto" else finite(option, text)
    except UserError:
        raise UserError(f"{option} {text} must be a number or auto") from None


def name_and_value(option: str, text: str) -> tuple[str, float]:
    """Return a name and a finite number from ``name=value``."""
    name, value = _parted(option, text, "name=value")
    return name, finite(f"{option} {name}", value)


def limits(option: str, text: str) -> tuple[str, tuple[float, float]]:
    """Return a name and two finite numbers from ``name=low:high``."""
    name, value = _parted(option, text, "name=low:high")
    ends = value.split(":")
    if len(ends) != 2:
        raise UserError(f"{option} {text} is not of the form name=low:high")
    return name, (finite(f"{option} {name}", ends[0]), finite(f"{option} {name}", ends[1]))


def name_and_values(option: str, text: str) -> tuple[str, list[str]]:
    """Return a name and texts, which semicolons separate where they hold commas."""
    name, value = _parted(option, text, "name=value,value,...")
    values = [one.strip() for one in value.split(";" if ";" in value else ",")]
    if not all(values):
        raise UserError(f"{option} {text} is not of the form name=value,value,...")
    return name, values


def name_and_deviation(option: str, text: str) -> tuple[str, float]:
    """Return a name and a finite number, infinite where there is none."""
    name, equals, known = text.partition("=")
    return name.strip(), finite(f"{option} {name.strip()}", known) if equals else math.inf


def _parted(option: str, text: str, form: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise UserError(f"{option} {text} is not of the form {form}")
    return name.strip(), value.strip()


#: Text readers by form, for options that are given once and for repeated options.
_ONCE: dict[str, Callable[[str, str], Any]] = {
    "N,N,...": numbers,
    "NAME,NAME,...": names,
    "ALONG,ACROSS": pair,
    "NUMBER|auto": number_or_auto,
}
_REPEATED: dict[str, Callable[[str, str], Any]] = {
    "X,Y": pair,
    "NAME": lambda _, text: text,
    "NAME=VALUE": name_and_value,
    "NAME=LOW:HIGH": limits,
    "NAME=V1,V2,...": name_and_values,
    "NAME[=STD]": name_and_deviation,
}

_PLAIN = (float, int, bool, Path, str)  #: Types that are read as they are.


def function_at(place: str) -> Callable[..., Any]:
    """Return the package's current function at ``module:name``, importing its module."""
    module, _, name = place.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(f"mitransient_lidar.{module}"), name)
    return found


@dataclass(frozen=True)
class Call:
    """The public function of a command, with the arguments that were given."""

    function: Callable[..., Any]
    arguments: Mapping[str, Any]
    quiet: bool
    takes_progress: bool
    flags: Mapping[str, str]

    def __call__(self, *given: Any, **more: Any) -> Any:
        """Call the function with further arguments, show progress, and name options in its sentences."""
        with reporting(self.quiet) as progress, self.named():
            shown = {"progress": progress} if self.takes_progress else {}
            return self.function(*given, **{**self.arguments, **shown, **more})

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Name parameters in errors as the options that the user typed, where they have a value or begin the text."""
        try:
            yield
        except UserError as error:
            text = re.sub(
                r"\b\w+(?= = )|^\w+(?= (must|holds|is) )", lambda word: self.flags.get(word[0], word[0]), str(error)
            )
            error.args = (text,)
            raise


@dataclass(frozen=True)
class Command:
    """One command: help heading, public function as ``module:name``, and a body that uses its result.

    `body`, whose documentation is the help text, takes the `Call`, then the command's own options, such as the output.
    `example` are arguments in the help; `defaults` the command's defaults where they differ from the function's.
    Without a function, `body` takes its own options alone.
    """

    body: Callable[..., None]
    heading: str
    function: str = ""
    example: str = ""
    defaults: Mapping[str, Any] = field(default_factory=dict)

    def callback(self, name: str) -> Callable[..., None]:
        """Return the function that Typer calls, with a signature of all options."""
        own = list(map(_own, inspect.signature(self.body, eval_str=True).parameters.values()))
        if not self.function:
            return _decorated(name, lambda **given: self.body(**given), own)
        function = function_at(self.function)
        known, options = inspect.signature(function).parameters, declared(function)
        defaults = {key: self.defaults.get(key, known[key].default) for key in options}
        flags = {key: flag(key, option) for key, (_, option) in options.items() if not option.is_argument}

        def run(**given: Any) -> None:
            arguments = {
                key: _read(option, flags.get(key, key), given.pop(key), defaults[key])
                for key, (_, option) in options.items()
            }
            if "params" in known:
                arguments["params"] = parameters(given.pop("define"))
            quiet = bool(given.get("quiet"))
            self.body(Call(function_at(self.function), arguments, quiet, "progress" in known, flags), **given)

        listed = [_parameter(key, kind, option, defaults[key]) for key, (kind, option) in options.items()]
        if "params" in known:
            listed.insert(sum(option.is_argument for _, option in options.values()), _keyword("define", None, Define))
        return _decorated(name, run, [*listed, *own[1:]])


class Commands(dict[str, Command]):
    """Commands by their names, in the order of the help."""

    def add(self, *row: Any, name: str = "", **more: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
        """Return a decorator that adds a body, by default under its own name; the rest are fields of `Command`."""

        def adding(body: Callable[..., None]) -> Callable[..., None]:
            self[name or body.__name__.strip("_").replace("_", "-")] = Command(body, *row, **more)
            return body

        return adding


def _decorated(name: str, run: Callable[..., None], listed: list[inspect.Parameter]) -> Callable[..., None]:
    """Return a function for Typer that keeps other files and can be silent."""
    listed = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in listed]
    run.__name__, run.__annotations__ = name.replace("-", "_"), {}
    run.__signature__ = inspect.Signature(listed)  # type: ignore[attr-defined]
    return keeping(silenced(run))


class LazyCommand(TyperCommand):
    """A command of a table, whose options are made when they are needed."""

    def __init__(self, name: str, row: Command, before: str = "") -> None:
        self._row, self._made = row, None  # type: tuple[Command, Any]
        text = inspect.cleandoc(row.body.__doc__ or "")
        text += f"\n\nExample: mitransient-lidar {before}{name} {row.example}" if row.example else ""
        super().__init__(name, help=text, rich_help_panel=row.heading, rich_markup_mode=None)

    def _full(self) -> Any:
        if self._made is None:
            app = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False, add_completion=False)
            app.command(self.name, help=self.help)(self._row.callback(str(self.name)))
            self._made = typer.main.get_command(app)
        return self._made

    @property
    def params(self) -> list[Any]:
        """Return arguments and options, to which Click adds the one for help."""
        found: list[Any] = self._full().params
        return found

    @params.setter
    def params(self, _none: object) -> None:
        pass

    @property
    def callback(self) -> Any:
        """Return the function that runs the command."""
        return self._full().callback

    @callback.setter
    def callback(self, _none: object) -> None:
        pass


def flag(name: str, option: Option) -> str:
    """Return an option's name."""
    return option.flag or f"--{name.replace('_', '-')}"


def typed(kind: Any, option: Option) -> Any:
    """Return the type that Typer reads."""
    parts = {kind, *get_args(kind)}
    if option.form in _REPEATED and not option.is_argument:
        return list[str] | None
    plain = next((one for one in _PLAIN if one in parts), str) if option.form not in _ONCE else str
    if Sequence[str] in parts and option.is_argument:
        return list[str] | None
    return plain | None if type(None) in parts else plain


def _typer(name: str, option: Option, default: Any) -> Any:
    """Return the declaration of an argument or option for Typer."""
    if option.is_argument:
        return typer.Argument(metavar=option.form or None, help=option.help())
    given = flag(name, option)
    return typer.Option(
        *(["-o"] if given == "--output" else []),
        given if default is not True else f"{given}/--no-{given.removeprefix('--')}",
        metavar=option.form or ("DIR" if option.meaning.startswith("Folder") else None),
        help=option.help(),
    )


def _parameter(name: str, kind: Any, option: Option, default: Any) -> inspect.Parameter:
    """Return a parameter of the callback, with the default as Typer shows it."""
    annotation: Any = Annotated[typed(kind, option), _typer(name, option, default)]
    if isinstance(default, (tuple, list)):
        text = [f"{one:g}" if isinstance(one, (int, float)) else str(one) for one in default]
        default = ",".join(text) if text and option.form not in _REPEATED else None
    return _keyword(name, default, annotation)


def _own(one: inspect.Parameter) -> inspect.Parameter:
    """Return a parameter of a body as Typer reads it."""
    if get_origin(one.annotation) is not Annotated or not isinstance(one.annotation.__metadata__[0], Option):
        return one
    return _parameter(one.name, one.annotation.__origin__, one.annotation.__metadata__[0], one.default)


def _keyword(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _read(option: Option, name: str, given: Any, default: Any) -> Any:
    """Return a function argument from Typer's value."""
    if given is None or given == []:
        return None if default is inspect.Parameter.empty else default
    if option.form in _ONCE:
        return _ONCE[option.form](name, given)
    if option.form in _REPEATED and not option.is_argument:
        found = [_REPEATED[option.form](name, text) for text in given]
        if "=" not in option.form:
            return found
        if len(dict(found)) < len(found):
            raise UserError(f"{name} names a parameter twice: give all its values in one option")
        return dict(found)
    return given
