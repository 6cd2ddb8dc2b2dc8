"""The loop over independent passes: seeds, end, progress and interruption."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.errors import UserError, is_interruption
from mitransient_lidar.core.validation import FloatArray, positive
from mitransient_lidar.rendering.interruption import DeferredInterrupt

#: Fewest passes to compare a standard error with the target; its own relative error is then 27 %.
SMALLEST_PASS_COUNT = 8


@dataclass(frozen=True)
class Progress:
    """Progress of a render or a study.

    Numbers of completed and, if known, planned units (``pass``, ``shot``, ``place`` or ``render``), elapsed and
    estimated remaining time [s], median and 95th percentile of the relative standard errors, and the requested error.
    """

    done: int
    planned: int | None
    unit: str = "pass"
    elapsed_s: float | None = None
    remaining_s: float | None = None
    error_median: float | None = None
    error_p95: float | None = None
    target_error: float | None = None


ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True)
class Goal:
    """End of a render: a number of passes, an accuracy, or a time, whichever comes first."""

    target_error: float | None = None
    max_time: float | None = None
    passes: int | None = None

    @classmethod
    def from_options(
        cls, target_error: float | None, max_time: float | None, passes: int | None, default: Goal
    ) -> Goal:
        """Check the options of a render; without any of them, return the default."""
        for name, value in (("target_error", target_error), ("max_time", max_time)):
            if value is not None:
                positive(name, value)
        if passes is not None and passes < 2:
            raise UserError(f"passes = {passes} must be at least 2: their spread gives the standard error")
        return default if target_error is max_time is passes is None else cls(target_error, max_time, passes)

    def reached(self, done: int, elapsed: float, error: float | None) -> bool:
        """Return whether to stop after `done` passes."""
        if done < 2:
            return False
        accurate = self.target_error is not None and (error or np.inf) <= self.target_error
        return (
            (self.passes is not None and done >= self.passes)
            or (self.max_time is not None and elapsed >= self.max_time)
            or (accurate and done >= SMALLEST_PASS_COUNT)
        )

    def remaining(self, done: int, elapsed: float, error: float | None) -> float | None:
        """Estimate the remaining time [s]; errors fall with the square root of the passes."""
        estimates = []
        if self.passes is not None:
            estimates.append(elapsed * (self.passes / done - 1))
        if self.max_time is not None:
            estimates.append(self.max_time - elapsed)
        if self.target_error is not None and error is not None and np.isfinite(error):
            needed = max(done * (error / self.target_error) ** 2, SMALLEST_PASS_COUNT)
            estimates.append(elapsed * (needed / done - 1))
        return max(0.0, min(estimates)) if estimates else None


@dataclass(frozen=True)
class PassLog:
    """Outcome of a loop over passes, which Ctrl-C may have interrupted.

    `edge_loss` is the energy lost at the edge of the surface mesh [J]; `error_median` and `error_p95` are the median
    and the 95th percentile of the relative standard errors, NaN without any.
    """

    count: int
    elapsed_s: float
    interrupted: bool
    edge_loss: float
    error_median: float
    error_p95: float

    def edge_loss_share(self, received: float) -> float:
        """Return the share of the energy lost at the edge of the surface mesh; `received` by all passes [J]."""
        return self.edge_loss / (self.edge_loss + received) if self.edge_loss > 0 else 0.0


def run_passes(
    render_pass: Callable[[int, int], float],
    goal: Goal,
    *,
    seed: int,
    errors: Callable[[], FloatArray] | None = None,
    smallest: int = 2,
    progress: ProgressCallback | None = None,
) -> PassLog:
    """Render independent passes until the goal is reached.

    Parameters
    ----------
    render_pass
        Called with the number and the seed of each pass; returns the energy lost at the edge of the surface mesh [J].
    goal
        End of the render.
    seed
        Seed of the render, any integer.
    errors
        Returns the relative standard errors, an array of any size; called from the second pass on.
    smallest
        Number of passes from which a Ctrl-C keeps the result, at least 2; before, it is raised.
    progress
        Called after every pass.

    Raises
    ------
    KeyboardInterrupt
        On a Ctrl-C during the first passes.
    """
    count, lost, interrupted = 0, 0.0, False
    median = p95 = None
    start = time.perf_counter()
    try:
        with DeferredInterrupt() as interruption:
            while not goal.reached(count, time.perf_counter() - start, p95):
                lost += render_pass(count, pass_seed(seed, count))
                count += 1
                if errors is not None and count > 1:
                    median, p95 = _percentiles(errors())
                if progress is not None:
                    elapsed = time.perf_counter() - start
                    left = goal.remaining(count, elapsed, p95)
                    progress(Progress(count, goal.passes, "pass", elapsed, left, median, p95, goal.target_error))
                if count >= smallest:
                    interruption.check()
    except (KeyboardInterrupt, RuntimeError) as error:
        if not is_interruption(error):
            raise
        if count < smallest:
            raise KeyboardInterrupt from error
        interrupted = True
    known = (np.nan if value is None else value for value in (median, p95))
    return PassLog(count, time.perf_counter() - start, interrupted, lost, *known)


def pass_seed(seed: int, number: int) -> int:
    """Return the seed of a pass, different from that of any other pass of any other seed."""
    sequence = np.random.SeedSequence([int(seed) & 0xFFFFFFFFFFFFFFFF, number])
    return int(sequence.generate_state(1, np.uint64)[0])


def _percentiles(errors: FloatArray) -> tuple[float | None, float | None]:
    """Return median and 95th percentile, None without errors."""
    if errors.size == 0:
        return None, None
    # Interpolation ("linear") would turn infinite errors, of bins without light, into NaN.
    median, p95 = np.quantile(errors, [0.5, 0.95], method="higher")
    return float(median), float(p95)
