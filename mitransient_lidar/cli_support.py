"""What the commands have in common: messages and exit codes, checks of options, progress."""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mitransient_lidar.errors import UserError

if TYPE_CHECKING:
    import xarray as xr
    from rich.console import Console

_WRONG_USE = 2
_INTERRUPTED = 130  # what shells report after Ctrl-C
_LISTED_PIXELS = 12  # pixels with a line of their own in the summary


@contextlib.contextmanager
def sentences() -> Iterator[None]:
    """Turn mistakes of the user's into one sentence and exit code 2, an interruption into exit code 130."""
    try:
        yield
    except UserError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(_WRONG_USE) from error
    except BrokenPipeError:
        raise  # the reader of stdout has left; Typer ends quietly
    except OSError as error:
        place = f" {error.filename}" if error.filename else ""
        typer.echo(f"cannot use{place}: {error.strerror or error}.", err=True)
        raise typer.Exit(_WRONG_USE) from error
    except KeyboardInterrupt as error:
        typer.echo("interrupted.", err=True)
        raise typer.Exit(_INTERRUPTED) from error


def positive(value: float) -> bool:
    """Return whether a number is finite and above 0."""
    return math.isfinite(value) and value > 0


def require(valid: bool, option: str, value: object, allowed: str) -> None:
    """Refuse the value of an option unless it is valid."""
    if not valid:
        raise UserError(f"{option} {value} is out of range: it must be {allowed}.")


def parameters(definitions: list[str]) -> dict[str, str]:
    """Return scene parameters given as ``name=value``."""
    params = {}
    for definition in definitions:
        name, equals, value = definition.partition("=")
        if not (name.strip() and equals):
            raise UserError(f"-D {definition} is not of the form name=value.")
        params[name.strip()] = value.strip()
    return params


def place(text: str) -> tuple[float, float]:
    """Return x and y [m] given as ``x,y``."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"--at {text} is not of the form x,y in metres.") from None
    return x, y


def numbers(option: str, text: str) -> list[float]:
    """Return numbers separated by commas."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise UserError(f"{option} {text} is not of the form 2,5,8.") from None


def require_writable(folder: Path, targets: list[Path]) -> None:
    """Find out before a long render, and without a trace, whether the results can be written."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise UserError(f"cannot write to folder {folder}: {error.strerror}.") from error
    for target in targets:
        if target.is_dir():
            raise UserError(f"cannot write {target}: it is a folder.")


@contextlib.contextmanager
def reporting(quiet: bool) -> Iterator[Callable[[Any], None] | None]:
    """Show log messages and a progress bar on stderr; yield the function that moves the bar."""
    import logging

    logger = logging.getLogger("mitransient_lidar")
    if quiet:
        logger.addHandler(logging.NullHandler())
        logger.propagate = False
        yield None
        return

    from rich.logging import RichHandler
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = _console()
    handler = RichHandler(console=console, show_path=False, show_time=False)
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("preparing", total=None)

            def show(state: Any) -> None:
                bar.update(task, description=_describe(state), completed=state.passes_done, total=state.passes_planned)

            yield show
    finally:
        logger.removeHandler(handler)


@contextlib.contextmanager
def counting(quiet: bool, what: str) -> Iterator[Callable[[int, int], None] | None]:
    """Show a progress bar on stderr; yield the function that takes what is done and planned."""
    if quiet:
        yield None
        return

    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=_console(), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, planned: bar.update(task, completed=done, total=planned)


def _describe(state: Any) -> str:
    """Say in one line how far a render is (`rendering.Progress`)."""
    planned = f"/{state.passes_planned}" if state.passes_planned is not None else ""
    parts = [f"pass {state.passes_done}{planned}"]
    if state.error_median is not None:
        goal = f" of {100 * state.target_error:.3g} %" if state.target_error is not None else ""
        parts.append(f"error {100 * state.error_median:.3g} %{goal}")
    if state.error_p95 is not None:
        parts.append(f"p95 {100 * state.error_p95:.3g} %")
    if state.remaining_s is not None:
        parts.append(f"{state.remaining_s:.0f} s left")
    return ", ".join(parts)


def prepare_drawing(path: Path | None) -> None:
    """Find out before long work whether a drawing, and the NetCDF file beside it, can be written."""
    if path is None:
        return
    from mitransient_lidar.plotting import check_format

    require_writable(path.parent, [path, path.with_suffix(".nc")])
    check_format(path)


def keep_drawing(dataset: xr.Dataset, path: Path, plot: Callable[[xr.Dataset, Path], Any]) -> Any:
    """Write a drawing and its data beside it, print both paths, and return what the drawing tells."""
    from mitransient_lidar import results

    path.parent.mkdir(parents=True, exist_ok=True)
    told = plot(dataset, path)
    data = path.with_suffix(".nc")
    with results.replacing(data) as temporary:
        dataset.to_netcdf(temporary, engine="h5netcdf")
    for written in (path, data):
        typer.echo(written)
    return told


def draw(dataset: xr.Dataset, path: Path, kind: str) -> None:
    """Write one of the drawings of a result: ``plot_waveforms`` or ``plot_layout``."""
    from mitransient_lidar import layout_plot, plotting

    functions = {"plot_waveforms": plotting.plot_waveforms, "plot_layout": layout_plot.plot_layout}
    functions[kind](dataset, path)


def summarise(dataset: xr.Dataset) -> None:
    """Print passes, time, error and the peak power of each pixel on stderr."""
    from rich.table import Table

    table = Table.grid(padding=(0, 2))

    def add(name: str, key: str, form: str, scale: float = 1.0) -> None:
        value = dataset.attrs.get(key)
        if isinstance(value, (int, float)):
            table.add_row(name, format(scale * value, form))

    add("passes", "passes", ".0f")
    add("time (s)", "elapsed_s", ".2f")
    add("median error (%)", "error_median", ".3g", 100.0)
    add("95th percentile error (%)", "error_p95", ".3g", 100.0)
    if "waveform" not in dataset:
        table.add_row("gates", str(dataset.sizes["gate"]))
        table.add_row("highest energy in a gate (J)", f"{float(dataset['gate_energy'].max()):.4g}")
        _console().print(table, markup=False)
        return
    peaks = dataset["waveform"].max("time")
    if "pixel" in peaks.dims and peaks.size <= _LISTED_PIXELS:
        for name, peak in zip(peaks["pixel"].values, peaks.values, strict=True):
            table.add_row(f"peak power, {name} (W)", f"{peak:.4g}")
    else:
        table.add_row("highest peak power (W)", f"{float(peaks.max()):.4g}")
    _console().print(table, markup=False)


def _console() -> Console:
    from rich.console import Console

    return Console(stderr=True, highlight=False)
