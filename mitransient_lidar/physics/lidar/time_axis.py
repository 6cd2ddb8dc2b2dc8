"""Time axis of waveforms: equal bins, whose start and number may follow from the light."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray

MOST_BINS = 1_000_000  #: Largest number of bins.
LONGEST_NS = 1e7  #: Longest time axis of automatic length [ns], in which light travels 3000 km.
_PARTS = 20  #: Parts of a fitted time axis, at least, between the readable times at which it may start and end.


@dataclass(frozen=True)
class TimeAxis:
    """Equal, half-open time bins [start, start + width); time is 0 when the pulse's peak leaves the transmitter."""

    start_ns: float  #: First bin's start [ns].
    bin_width_ns: float  #: Bin width [ns], positive.
    bin_count: int  #: Number of bins, at least 1.

    @classmethod
    def covering(
        cls,
        first_ns: float,
        last_ns: float,
        bin_width_ns: float,
        start_ns: float | None = None,
        bin_count: int | None = None,
    ) -> TimeAxis:
        """Return the bins for times from `first_ns` to `last_ns` [ns].

        Start and number of bins, unless given, are multiples of a step: 1, 2 or 5 times a power of ten of bins. The
        step is at most a twentieth of these times.

        Raises UserError if there are more than 1 000 000 bins, or the length is automatic and more than 10 ms.
        """
        begin = first_ns if start_ns is None else start_ns
        bins = max(last_ns - min(begin, first_ns), 0.0) / bin_width_ns
        steps = (factor * 10**power for power in itertools.count() for factor in (1, 2, 5))
        # The largest step within a twentieth of the times.
        step = max([1, *itertools.takewhile(lambda each: each * _PARTS <= bins, steps)])
        if start_ns is None:
            start_ns = step * math.floor(first_ns / (step * bin_width_ns)) * bin_width_ns
        if bin_count is None:
            if last_ns - start_ns > LONGEST_NS:
                raise UserError(
                    f"the time axis from {start_ns:g} to {last_ns:g} ns is longer than {LONGEST_NS:g} ns, the most of "
                    "an automatic one: give time_start_ns and bin_count"
                )
            bin_count = step * max(math.ceil((last_ns - start_ns) / (step * bin_width_ns) - 1e-9), 1)
        if bin_count > MOST_BINS:
            raise UserError(
                f"bin_width_ns = {bin_width_ns:g} divides the time axis from {start_ns:g} to {last_ns:g} ns into "
                f"{bin_count} bins: it must be at least {(last_ns - start_ns) / MOST_BINS:.2g}, for at most {MOST_BINS}"
            )
        return cls(start_ns, bin_width_ns, bin_count)

    @property
    def centres_ns(self) -> FloatArray:
        """Bin centres [ns], shape (bin_count,)."""
        return np.asarray(self.start_ns + self.bin_width_ns * (np.arange(self.bin_count) + 0.5))

    @property
    def edges_ns(self) -> FloatArray:
        """Bin edges [ns], shape (bin_count + 1,)."""
        return np.asarray(self.start_ns + self.bin_width_ns * np.arange(self.bin_count + 1))

    @property
    def end_ns(self) -> float:
        """End of the last bin [ns]."""
        return self.start_ns + self.bin_width_ns * self.bin_count

    @property
    def path_end(self) -> float:
        """Optical path length of light that arrives at the last bin's end [m]."""
        return self.end_ns * 1e-9 * C0
