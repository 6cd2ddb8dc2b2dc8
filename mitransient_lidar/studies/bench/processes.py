"""Benchmark measurements, each in its own process: peak memory and compile time are independent of the others."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from mitransient_lidar.core.errors import UserError

#: Measurement values: task labels and arguments.
Tasks = Mapping[tuple[str, ...], Mapping[str, Any]]


def run_processes(
    module: str, heading: tuple[str, ...], tasks: Tasks, columns: Mapping[str, str], as_json: bool, groups: str = ""
) -> None:
    """Run a module in this folder for each task in its own process, and print the figures as a table or as JSON.

    Tasks are given by their labels, with the headings `heading`; `columns` are the figures' headings. With the heading
    `groups` a task returns the figures for several rows by their labels.
    """
    figures: dict[str, Any] = {}
    if not as_json:
        print(_row([*heading, *([groups] if groups else [])], columns.values()))
    for labels, task in tasks.items():
        command = [sys.executable, "-m", f"{__package__}.{module}", json.dumps(task)]
        with tempfile.TemporaryDirectory() as folder:
            # In its own session: after Ctrl-C, it would print its part as if it were all.
            done = subprocess.run(
                command,
                check=False,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
                env={**os.environ, "TMPDIR": folder},
            )
        if done.returncode:
            raise UserError(f"the benchmark of {' with '.join(labels)} ended with exit code {done.returncode}")
        values = json.loads(done.stdout)
        group = figures
        for label in labels[:-1]:
            group = group.setdefault(label, {})
        group[labels[-1]] = values
        rows = {(*labels, label): row for label, row in values.items()} if groups else {labels: values}
        for row_labels, row in rows.items() if not as_json else ():
            print(_row(row_labels, (f"{row[key]:.4g}" for key in columns)), flush=True)
    if as_json:
        print(json.dumps(figures, indent=2))


def answer(measure: Callable[..., Any]) -> None:
    """Print this process's task figures."""
    print(json.dumps(measure(**json.loads(sys.argv[1]))))


def peak_mb() -> float:
    """Return the largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _row(labels: Iterable[str], cells: Iterable[str]) -> str:
    return " ".join([*(f"{label:<14}" for label in labels), *(f"{cell:>10}" for cell in cells)])
