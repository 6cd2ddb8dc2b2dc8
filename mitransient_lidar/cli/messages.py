"""Messages and exit codes, progress, and the summary of a render."""

from __future__ import annotations

import contextlib
import functools
import logging
import sys
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mitransient_lidar.core.errors import LINES, UserError, is_interruption, printable, raise_if_out_of_memory
from mitransient_lidar.core.interruption import TerminationAsInterrupt
from mitransient_lidar.core.tables.written import aligned_lines, table_lines

if TYPE_CHECKING:
    import xarray as xr
    from rich.console import Console

    from mitransient_lidar.rendering.passes import Progress

_FAILED, _INVALID_INPUT = 1, 2  # exit codes
_MOST_PIXELS = 12  # listed in the summary
_REPORT_S = 15.0  # between two progress lines


class _PrintableStream:
    """Text stream that writes only `printable` text and line ends; `unfiltered` is the stream behind it."""

    def __init__(self, stream: Any) -> None:
        self.unfiltered = stream

    def write(self, text: str) -> int:
        """Write a text, with escapes for characters that the stream's encoding lacks."""
        encoding = self.unfiltered.encoding or "utf-8"
        shown = printable(text, kept=LINES).encode(encoding, "backslashreplace").decode(encoding)
        return int(self.unfiltered.write(shown))

    def writelines(self, lines: Iterable[str]) -> None:
        """Write texts."""
        self.write("".join(lines))

    def __getattr__(self, name: str) -> Any:
        if name == "buffer":
            # Click would write to it where the encoding is ASCII.
            raise AttributeError(name)
        return getattr(self.unfiltered, name)


@contextlib.contextmanager
def printable_streams() -> Iterator[None]:
    """Write no control characters to standard output and error: names in files may steer a terminal.

    Rich alone, which draws with them, writes to the streams behind, and is given `printable` texts.
    """
    out, err = (stream and _PrintableStream(stream) for stream in (sys.stdout, sys.stderr))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield


class _PrintableLog(logging.Formatter):
    """Log format without control characters."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record's message."""
        return printable(super().format(record), kept=LINES)


@contextlib.contextmanager
def exit_on_error() -> Iterator[None]:
    """Exit with one sentence and code 2 on invalid input, unusable files and exhausted memory.

    Ctrl-C, SIGTERM and SIGHUP give the codes 130, 143 and 129.
    """
    with TerminationAsInterrupt() as signals:
        try:
            try:
                yield
            except (MemoryError, RuntimeError) as error:
                if is_interruption(error):
                    raise KeyboardInterrupt from error
                raise_if_out_of_memory(error)
                raise
        except UserError as error:
            typer.echo(str(error), err=True)
            raise typer.Exit(_INVALID_INPUT) from error
        except BrokenPipeError:
            raise  # stdout is closed; Typer exits without a message
        except OSError as error:
            place = f" {error.filename}" if error.filename else ""
            typer.echo(f"cannot use{place}: {error.strerror or error}.", err=True)
            raise typer.Exit(_INVALID_INPUT) from error
        except KeyboardInterrupt as error:
            typer.echo(str(error) or "interrupted.", err=True)
            raise typer.Exit(signals.exit_code) from error


def exit_if_interrupted(dataset: xr.Dataset) -> None:
    """Exit as interrupted if an interruption ended the render of a result, series or frames, or a fit."""
    if dataset.attrs.get("interrupted"):
        if "shot" in dataset.dims:
            done = f"{dataset.sizes['shot']} of the shots"
        elif "pulse_time" in dataset:  # images by daylight have frames, too, all of which are there
            done = f"{dataset.sizes['frame']} of {dataset.attrs['frames']} frames"
        elif "renders" in dataset.attrs:
            done = f"{dataset.attrs['renders']} renders, before the fit has converged"
        else:
            done = f"{dataset.attrs['passes']} passes"
        raise KeyboardInterrupt(f"interrupted after {done}; their result is kept")


def exit_if_failed(path: Path) -> None:
    """Exit with code 1 and a sentence if campaign runs or flight shots have failed."""
    import numpy as np

    from mitransient_lidar.campaigns.store import FAILED, Store

    store = Store(path)
    failed = np.flatnonzero(store.status() == FAILED)
    if len(failed):
        first = f"the first, {store.unit} {failed[0]}, so: {store.errors()[failed[0]]}"
        typer.echo(f"{len(failed)} of {store.count} {store.unit}s failed, {first}", err=True)
        raise typer.Exit(_FAILED)


def name_subject(file: Path, attributes: Mapping[Hashable, Any], quiet: bool = False) -> None:
    """Print a command's subject on stderr: a file, and the scene, instrument and integrator of its result."""
    found = {name: str(attributes.get(name, "")) for name in ("scene", "instrument", "integrator")}
    found["scene"] = Path(found["scene"]).stem
    named = ", ".join(f"{name} {value}" for name, value in found.items() if value)
    if not quiet:
        typer.echo(f"{file}: {named or 'it names no scene'}", err=True)


@contextlib.contextmanager
def _logging(handler: logging.Handler, level: int, *, propagate: bool) -> Iterator[None]:
    """Send the package's log messages to a handler, and to the root logger's handlers if `propagate`."""
    logger = logging.getLogger("mitransient_lidar")
    before = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(level)
    logger.propagate = propagate
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before[0])
        logger.propagate = before[1]


def silenced(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that shows no log messages with --quiet, to its end: files are written and drawn late."""

    @functools.wraps(command)
    def run(**options: Any) -> None:
        if not options.get("quiet"):
            command(**options)
            return
        with _logging(logging.NullHandler(), logging.NOTSET, propagate=False):
            command(**options)

    return run


@contextlib.contextmanager
def reporting(quiet: bool) -> Iterator[Callable[[Progress], None] | None]:
    """Show log messages and progress on stderr; yield the function that takes the progress, None if `quiet`.

    On a terminal it is a bar; elsewhere, as in a pipe or a log, a line every 15 s.
    """
    if quiet:
        yield None
        return
    from rich.logging import RichHandler
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as ProgressBar
    from rich.table import Column

    console = _console()
    handler: logging.Handler = logging.StreamHandler(console.file)  # which wraps no lines
    handler.setFormatter(_PrintableLog("%(levelname)-8s %(message)s"))
    if console.is_terminal:
        handler = RichHandler(console=console, show_path=False, show_time=False)
        handler.setFormatter(_PrintableLog("%(message)s"))
    with _logging(handler, logging.INFO, propagate=True):
        description = TextColumn("{task.description}", table_column=Column(no_wrap=False, ratio=1))
        columns = (SpinnerColumn(), description, BarColumn(bar_width=16), TimeElapsedColumn())
        if not console.is_terminal:
            with _lines_of_progress() as show_line:
                yield show_line
            return
        # Rich would write other output, with its control characters.
        bar = ProgressBar(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False)
        with bar:
            task = bar.add_task("preparing", total=None)

            def show(state: Progress) -> None:
                expected = state.planned or (None if state.needed_passes is None else state.done + state.needed_passes)
                text = printable(str(state))
                bar.update(task, description=text, completed=state.done, total=expected)

            yield show


@contextlib.contextmanager
def _lines_of_progress() -> Iterator[Callable[[Progress], None]]:
    """Print the latest progress and the elapsed time as a line every 15 s, whether or not there is news."""
    import threading
    import time

    began, finished = time.monotonic(), threading.Event()
    latest: list[Progress] = []

    def report() -> None:
        while not finished.wait(_REPORT_S):
            text = str(latest[-1]) if latest else "preparing"
            typer.echo(f"{text}, {time.monotonic() - began:.0f} s so far", err=True)

    thread = threading.Thread(target=report, daemon=True)
    thread.start()
    try:
        yield lambda state: latest.__setitem__(slice(None), [state])
    finally:
        finished.set()
        thread.join()


def summarise(dataset: xr.Dataset) -> None:
    """Print passes, time, error and the peak power of each pixel on stderr."""
    rows: list[tuple[str, str]] = []

    def add(name: str, key: str, form: str, scale: float = 1.0) -> None:
        value: Any = dataset.attrs.get(key)
        if isinstance(value, (int, float)):
            rows.append((name, format(scale * value, form)))

    add("passes", "passes", ".0f")
    add("time (s)", "elapsed_s", ".2f")
    add("median error (%)", "error_median", ".3g", 100.0)
    add("95th percentile error (%)", "error_p95", ".3g", 100.0)
    add("target error (%)", "target_error", ".3g", 100.0)
    if dataset.attrs.get("target_quantile") not in (None, 0.95):
        add(f"{100 * dataset.attrs['target_quantile']:g}th percentile error (%)", "error_at_quantile", ".3g", 100.0)
    if "waveform" not in dataset:
        rows.append(("gates", str(dataset.sizes["gate"])))
        rows.append(("highest energy in a gate (J)", f"{float(dataset['gate_energy'].max()):.4g}"))
    else:
        peaks = dataset["waveform"].max("time")
        if "pixel" in peaks.dims and peaks.size <= _MOST_PIXELS:
            named = zip(peaks["pixel"].values, peaks.values, strict=True)
            rows += [(printable(f"peak power, {name} (W)"), f"{peak:.4g}") for name, peak in named]
        else:
            rows.append(("highest peak power (W)", f"{float(peaks.max()):.4g}"))
    lines = aligned_lines(rows)
    if "waveform_by_origin" in dataset:
        lines += _by_origin(dataset)
    typer.echo("\n".join(lines), err=True)


def _by_origin(dataset: xr.Dataset) -> list[str]:
    """Return the lines of a table: energy, and peak power with its time, of the light of each origin."""
    columns = (("all pixels", "<12"), ("energy (J)", ">12.3e"), ("peak (W)", ">12.3e"), ("at (ns)", ">10.1f"))
    rows = []
    for one in dataset["origin"].values:
        part = dataset.sel(origin=one)
        received = float(part["impulse_response_by_origin"].sum())
        power = part["waveform_by_origin"].sum([dim for dim in part["waveform_by_origin"].dims if dim != "time"])
        peak = (float(power.max()), float(power.idxmax("time")))
        rows.append((printable(str(one)), received, *(peak if received > 0 else ())))
    return table_lines(columns, rows)


def _console() -> Console:
    from rich.console import Console

    return Console(stderr=True, file=getattr(sys.stderr, "unfiltered", None), highlight=False)
