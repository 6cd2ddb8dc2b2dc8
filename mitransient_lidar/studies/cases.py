"""The loop over the cases of a study: end by time, progress, and interruption."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Generic, TypeVar

import xarray as xr

from mitransient_lidar.rendering.passes import Progress, ProgressCallback

_LOG = logging.getLogger(__name__)
_Case = TypeVar("_Case")


class Cases(Generic[_Case]):
    """Cases in a study, such as designs, depths or locations, one after the other.

    Warnings have their name in the plural, such as ``designs``. A case has `steps` units of progress. None begins after
    `max_time` [s], None for no limit; those before the first kept result always do.
    """

    def __init__(
        self,
        cases: Sequence[_Case],
        name: str,
        *,
        unit: str = "render",
        steps: int = 1,
        max_time: float | None = None,
        progress: ProgressCallback | None = None,
    ) -> None:
        self.cases = cases
        self.begun, self.kept = 0, 0  #: Numbers of cases that have begun, and of kept results.
        self._name, self._unit, self._steps = name, unit, steps
        self._max_time, self._progress = max_time, progress
        self._start, self._done = time.perf_counter(), 0
        self.left = max_time  #: Time that was left when the case began [s], None without a limit.

    def __iter__(self) -> Iterator[_Case]:
        """Return the cases that begin in time, and warn of the others."""
        for case in self.cases:
            if self._max_time is not None:
                self.left = self._max_time - (time.perf_counter() - self._start)
            if self.kept and self.left is not None and self.left <= 0:
                _LOG.warning(
                    "max_time = %g s ended after %d of %d %s", self._max_time, self.begun, len(self.cases), self._name
                )
                return
            self.begun += 1
            yield case

    @property
    def left_out(self) -> int:
        """Number of cases that have not begun."""
        return len(self.cases) - self.begun

    def keep(self, result: xr.Dataset) -> xr.Dataset:
        """Return a result, of which the study needs all; raise KeyboardInterrupt if its render was interrupted."""
        if result.attrs.get("interrupted"):
            planned = len(self.cases) * self._steps
            raise KeyboardInterrupt(f"interrupted after {self._done} of {planned} {self._unit}s, and none is kept")
        self.kept += 1
        return result

    def step(self, inner: Progress | None = None) -> None:
        """Report that a unit is done, or how far a study that is a case of this one has come."""
        steps, before = self._steps, self._done
        if inner is not None and inner.planned is not None:
            steps, before = inner.planned, (self.begun - 1) * inner.planned + inner.done - 1
        self._done = before + 1
        if self._progress is None:
            return
        planned, elapsed = len(self.cases) * steps, time.perf_counter() - self._start
        left = elapsed / self._done * (planned - self._done)
        state = Progress(self._done, planned, self._unit) if inner is None else replace(inner, unit=self._unit)
        self._progress(replace(state, done=self._done, planned=planned, elapsed_s=elapsed, remaining_s=left))
