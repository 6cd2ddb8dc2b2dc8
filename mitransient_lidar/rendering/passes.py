"""The loop over independent passes: options, seeds, end, progress and interruption."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import numpy as np

from mitransient_lidar.core.errors import UserError, is_interruption, raise_if_out_of_memory
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.options import Option, declared, positive_option
from mitransient_lidar.core.validation import FloatArray

MOST_PASSES = 10**9  #: Largest number of passes allowed.
DEFAULT_MAX_MEMORY_GB = 2.0  #: Memory for histograms, unless another one is requested [GB].
SMALLEST_SHARE = 2**-9  #: Smallest share of a full pass's paths.

TargetError = Annotated[
    float | None,
    Option(
        "Stop at this relative standard error in 95 % of the bins of lit pixels, surface echo to bottom echo, or in "
        "95 % of the gates or of an image's lit pixels. By default 0.03 within 300 s, with gates 0.1 within 60 s, "
        "for images 0.05 within 120 s",
        *(0, 1),
        above=True,
    ),
]
TargetQuantile = Annotated[
    float | None, Option("Share that must reach the target error, by default 0.95; 0.5 is the median", 0.01, 1)
]
MaxTime = Annotated[
    float | None,
    positive_option("Stop before this many seconds, after at least two passes; by default see target error"),
]
Passes = Annotated[
    int | None, Option("Stop after this many independent passes, by default at the target error", 2, MOST_PASSES)
]
RenderSeed = Annotated[int | None, Option("Random seed, by default 0", 0, 2**53)]
PassShare = Annotated[float | None, Option("Share of a full pass's paths in each pass", SMALLEST_SHARE, 1)]
MaxMemory = Annotated[
    float | None, positive_option("Memory for histograms [GB], by default 2; with less, only gates are kept")
]
Components = Annotated[bool | None, Option("Also separate the light by surface, water, bottom and targets")]
Derivatives = Annotated[
    list[str] | str | None,
    Option(
        "Also differentiate the waveforms by this parameter, e.g. attenuation, bottom_reflectance or bottom_depth. "
        "Repeatable",
        form="NAME",
    ),
]
Batches = Annotated[
    int | None,
    Option(
        "Also keep this many batch waveforms, from which a fit to the result takes its error correlation", *(2, 256)
    ),
]
Smooth = Annotated[
    float | None,
    Option(
        "Smooth gate images by a Gaussian with this standard deviation [pixels]: less noise, and a bias, which "
        "results state. Only gates are kept",
        *(0.2, 20),
    ),
]
#: Ways to compute the light, of series and of a render.
LIGHT = ("merging", "maps")
LIGHT_OF_RENDERS = (*LIGHT, "level")
_LIGHT = (
    "Computation of the light: merging (the default), or maps of the beam at several depths: several times faster, "
    "within 1 %"
)
LightOption = Annotated[str, Option(_LIGHT, form="|".join(LIGHT))]
Light = Annotated[
    str | None,
    Option(
        f"{_LIGHT}; level for a first look in about a second: maps below a level sea", form="|".join(LIGHT_OF_RENDERS)
    ),
]
Variant = Annotated[str | None, Option("Mitsuba variant, e.g. llvm_ad_mono")]

#: Options that results keep, and the attributes that hold them.
KEPT = {name: name for name in ("passes", "seed", "pass_share", "variant")} | {"max_memory": "max_memory_gb"}


@dataclass(frozen=True)
class RenderOptions:
    """Options of a render, None for those that are not given. The commands show their meanings as help.

    Raises UserError if a number is out of range, or a quantile has no error that it must reach.
    """

    target_error: TargetError = None
    target_quantile: TargetQuantile = None
    max_time: MaxTime = None
    passes: Passes = None
    seed: RenderSeed = None
    pass_share: PassShare = None
    max_memory: MaxMemory = None
    components: Components = None
    derivatives: Derivatives = None
    batches: Batches = None
    smooth: Smooth = None
    light: Light = None
    variant: Variant = None

    def __post_init__(self) -> None:
        options = declared(RenderOptions)
        for one in fields(self):
            if (value := getattr(self, one.name)) is not None:
                kind, option = options[one.name]
                object.__setattr__(self, one.name, option.check(one.name, value, kind))
        if self.target_quantile is not None and self.target_error is None and (self.passes or self.max_time):
            raise UserError(
                f"target_quantile = {self.target_quantile:g} needs a target_error: the error that it must reach"
            )
        if self.derivatives and self.light in LIGHT_OF_RENDERS[1:]:
            raise UserError(f"light = {self.light!r} has no derivatives: use light = 'merging'")
        if self.smooth is not None and (self.components or self.derivatives or self.batches):
            raise UserError(
                f"smooth = {self.smooth:g} keeps gates alone: leave out components, derivatives and batches"
            )


logger = logging.getLogger(__name__)

TOLERATED_LOSS = 1e-3  #: Share of the energy lost at the surface mesh's edge above which a warning is given.

#: Fewest passes to compare a standard error with the target; its own relative error is then 27 %.
SMALLEST_PASS_COUNT = 8

#: Quantile of the relative standard errors that is compared with the target, unless another one is requested.
DEFAULT_QUANTILE = 0.95


@dataclass(frozen=True)
class Progress:
    """Progress in a render or a study.

    Contains the numbers of completed and, if known, planned units (``pass``, ``shot``, ``place``, ``render`` or
    ``run``), and the elapsed and estimated remaining time [s]. Also the relative standard errors' median and 95th
    percentile, the requested error, the number of completed units that have `failed`, and the `rate` [units/s].

    With a requested error it also contains the quantile of the relative standard errors that must reach it, and this
    quantile's value. The errors belong to ``bins``, ``gates`` or ``pixels``. Estimates of the passes and the time [s]
    still needed are None while they are unknown.
    """

    done: int
    planned: int | None
    unit: str = "pass"
    elapsed_s: float | None = None
    remaining_s: float | None = None
    error_median: float | None = None
    error_p95: float | None = None
    target_error: float | None = None
    target_quantile: float = DEFAULT_QUANTILE
    error: float | None = None
    errors_of: str = "bins"
    needed_passes: int | None = None
    needed_s: float | None = None
    failed: int = 0
    rate: float | None = None

    def __str__(self) -> str:
        """Return the progress in one line."""
        parts = [f"{self.unit} {self.done}" + ("" if self.planned is None else f"/{self.planned}")]
        if self.failed:
            parts.append(f"{self.failed} failed")
        if self.rate is not None:
            parts.append(f"{self.rate:.3g} a second")
        if self.error is not None:
            parts.append(f"{describe_quantile(self.target_quantile, self.errors_of)} within {100 * self.error:.3g} %")
        if self.target_error is not None:
            needed = "" if self.needed_s is None else f" in {self.needed_passes} more passes, {self.needed_s:.0f} s"
            parts.append(f"target {100 * self.target_error:.3g} %{needed}")
        if self.remaining_s is not None and self.remaining_s != self.needed_s:
            parts.append(f"ends in {self.remaining_s:.0f} s")
        return ", ".join(parts)


ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True)
class Goal:
    """Render end: number of passes, accuracy or time [s], whichever comes first.

    The accuracy is reached when `target_quantile` of the relative standard errors are at most `target_error`.
    """

    target_error: float | None = None
    max_time: float | None = None
    passes: int | None = None
    target_quantile: float = DEFAULT_QUANTILE

    @classmethod
    def from_options(
        cls,
        target_error: float | None,
        max_time: float | None,
        passes: int | None,
        default: Goal,
        target_quantile: float | None = None,
    ) -> Goal:
        """Check a render's options; without any, return the default."""
        options = RenderOptions(target_error, target_quantile, max_time, passes)
        ends = options.target_error, options.max_time, options.passes
        goal = default if ends == (None, None, None) else cls(*ends)
        return goal if options.target_quantile is None else replace(goal, target_quantile=options.target_quantile)

    def reached(self, done: int, elapsed: float, last: float, error: float | None) -> bool:
        """Return whether to stop after `done` passes: another one, as long as the last [s], would exceed the time."""
        if done < 2:
            return False
        return (
            (self.passes is not None and done >= self.passes)
            or (self.max_time is not None and elapsed + last > self.max_time)
            or (done >= SMALLEST_PASS_COUNT and self.is_accurate(error))
        )

    def is_accurate(self, error: float | None) -> bool:
        """Return whether the errors' quantile is at most the requested error."""
        return self.target_error is not None and error is not None and error <= self.target_error

    def needed_passes(self, done: int, error: float | None) -> int | None:
        """Estimate the passes still needed for the requested error, which falls with their square root."""
        if self.target_error is None or error is None or not np.isfinite(error):
            return None
        return max(round(max(done * (error / self.target_error) ** 2, SMALLEST_PASS_COUNT)) - done, 0)

    def remaining(self, done: int, elapsed: float, pace: float, error: float | None) -> float | None:
        """Estimate the remaining time [s] from a pass's time [s]."""
        estimates = []
        if self.passes is not None:
            estimates.append(pace * (self.passes - done))
        if self.max_time is not None:
            estimates.append(self.max_time - elapsed)
        if (needed := self.needed_passes(done, error)) is not None:
            estimates.append(pace * needed)
        return max(0.0, min(estimates)) if estimates else None


@dataclass(frozen=True)
class PassLog:
    """Outcome of a loop over passes, which Ctrl-C may have interrupted.

    `edge_loss` is the energy lost at the edge of the surface mesh [J]; `error_median`, `error_p95` and `error` are the
    relative standard errors' median, 95th percentile and goal quantile, NaN without any; `needed_s` is the time still
    needed for the requested error [s], 0 if it was reached and NaN if it is unknown.
    """

    count: int
    elapsed_s: float
    interrupted: bool
    edge_loss: float
    goal: Goal
    needed_s: float
    error_median: float
    error_p95: float
    error: float

    def edge_loss_share(self, received: float) -> float:
        """Return the energy share lost at the surface mesh's edge; `received` by all passes [J]."""
        return self.edge_loss / (self.edge_loss + received) if self.edge_loss > 0 else 0.0

    def attributes(self, seed: int) -> dict[str, Any]:
        """Return the result attributes that describe its passes.

        With a requested error: the error and its quantile, and the reached error. Also an estimate of the time still
        needed [s], 0 if the request was met and NaN if unknown.
        """
        attributes = {"seed": int(seed), "passes": self.count, "interrupted": int(self.interrupted)}
        if self.goal.target_error is None:
            return attributes
        return attributes | {
            "target_error": self.goal.target_error,
            "target_quantile": self.goal.target_quantile,
            "error_at_quantile": self.error,
            "target_missing_s": self.needed_s,
        }


def run_passes(
    render_pass: Callable[[int, int], float],
    goal: Goal,
    *,
    seed: int,
    errors: Callable[[], FloatArray] | None = None,
    errors_of: str = "bins",
    verify: Callable[[int], None] | None = None,
    smallest: int = 2,
    progress: ProgressCallback | None = None,
) -> PassLog:
    """Render independent passes until the goal is reached.

    Warns when the passes or the time end before the requested error is reached, or the time before the passes.

    `render_pass`: called with each pass's number and seed; returns the energy lost at the surface mesh's edge [J].
    `goal`: render end. `seed`: render seed, a 64-bit integer with a sign. `errors`: returns the relative standard
    errors, an array with any size; called from the second pass on. `errors_of`: unit to which the errors belong:
    ``bins``, ``gates`` or ``pixels``. `verify`: called with the number of passes at 8 passes, and at the end; raises
    UserError if the result is useless. `smallest`: number of passes that a result needs, at least 2: no goal ends the
    render before, and a Ctrl-C is raised, after the second pass. `progress`: called after every pass.

    Raises `KeyboardInterrupt` on a Ctrl-C during the first passes. Raises `UserError` from `verify`, or if memory runs
    out.
    """
    count, lost, interrupted = 0, 0.0, False
    median = p95 = error = None
    ends = [time.perf_counter()]
    try:
        with DeferredInterrupt() as interruption:
            while count < smallest or not goal.reached(
                count, time.perf_counter() - ends[0], ends[-1] - ends[-2:][0], error
            ):
                lost += render_pass(count, pass_seed(seed, count))
                count += 1
                if errors is not None and count > 1:
                    median, p95, error = _quantiles(errors(), goal.target_quantile)
                if verify is not None and count == SMALLEST_PASS_COUNT:
                    verify(count)
                ends.append(time.perf_counter())
                if progress is not None:
                    elapsed, pace, needed = ends[-1] - ends[0], _pace(ends), goal.needed_passes(count, error)
                    left = goal.remaining(count, elapsed, pace, error)
                    state = Progress(
                        done=count,
                        planned=goal.passes,
                        elapsed_s=elapsed,
                        remaining_s=None if left is None else max(left, pace * (smallest - count)),
                        error_median=median,
                        error_p95=p95,
                        target_error=goal.target_error,
                        target_quantile=goal.target_quantile,
                        error=error,
                        errors_of=errors_of,
                        needed_passes=needed,
                        needed_s=None if needed is None else pace * needed,
                    )
                    progress(state)
                if count > 1:  # one pass has no errors, and no result
                    interruption.check()
    except (KeyboardInterrupt, RuntimeError, MemoryError) as raised:
        if not is_interruption(raised):
            raise_if_out_of_memory(raised)
            raise
        if count < smallest:
            raise KeyboardInterrupt from raised
        interrupted = True
    if verify is not None and not interrupted:
        verify(count)
    accurate, needed = goal.is_accurate(error), goal.needed_passes(count, error)
    needed_s = 0.0 if accurate else np.nan if needed is None else _pace(ends) * needed
    known = [np.nan if value is None else value for value in (median, p95, error)]
    log = PassLog(count, time.perf_counter() - ends[0], interrupted, lost, goal, needed_s, *known)
    if error is not None and goal.target_error is not None and not accurate:
        logger.warning(_shortfall(log, errors_of, needed))
    elif goal.target_error is None and goal.passes is not None and count < goal.passes and not interrupted:
        logger.warning("max_time = %g s ended after %d of %d passes", goal.max_time, count, goal.passes)
    return log


def warn_of_edge_loss(share: float) -> None:
    """Warn when a large share of the energy is lost at the surface mesh's edge."""
    if share > TOLERATED_LOSS:
        logger.warning(
            "the surface is smaller than the spread of the light in the water: about %.2g %% of the received energy is "
            "lost at its edge; enlarge the surface's size",
            100 * share,
        )


def describe_quantile(quantile: float, errors_of: str) -> str:
    """Return what must reach the requested error, e.g. "95 % of the bins of lit pixels"."""
    what = {"bins": "bins of lit pixels", "gates": "gates (medians over lit pixels)", "pixels": "lit pixels"}
    return f"{100 * quantile:g} % of the {what[errors_of]}"


def _shortfall(log: PassLog, errors_of: str, needed: int | None) -> str:
    """Return the error reached instead of the requested one, and the passes and time that the latter needs."""
    share, target = (
        describe_quantile(log.goal.target_quantile, errors_of),
        f"target_error = {log.goal.target_error:.3g}",
    )
    ended = f"ended after {log.count} passes and {log.elapsed_s:.3g} s, before {target}"
    if needed is None:
        return f"{ended}: fewer than {share} have received light, so that the time for it is unknown"
    total = f"about {log.count + needed} passes and {log.elapsed_s + log.needed_s:.3g} s"
    return f"{ended}: {share} reached {log.error:.3g}; the target takes {total}"


def _pace(ends: list[float]) -> float:
    """Return the time per pass [s] from the passes' start and ends.

    The first pass includes kernel compilation and is left out where there are others.
    """
    first = 1 if len(ends) > 2 else 0
    return (ends[-1] - ends[first]) / (len(ends) - 1 - first)


def pass_seed(seed: int, number: int) -> int:
    """Return a pass seed, different from any other pass seed with any other seed."""
    sequence = np.random.SeedSequence([int(seed) & 0xFFFFFFFFFFFFFFFF, number])
    return int(sequence.generate_state(1, np.uint64)[0])


def render_seed(seed: int, number: int) -> int:
    """Return the seed of one of a study's renders, within the range of seeds."""
    return pass_seed(seed, number) >> 11


def _quantiles(errors: FloatArray, quantile: float) -> tuple[float | None, float | None, float | None]:
    """Return median, 95th percentile and another quantile, None without errors."""
    if errors.size == 0:
        return None, None, None
    # Interpolation ("linear") would turn infinite errors, of bins without light, into NaN.
    median, p95, wanted = np.quantile(errors, [0.5, 0.95, quantile], method="higher")
    return float(median), float(p95), float(wanted)
