"""Time bins of a record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray


@dataclass(frozen=True)
class TimeAxis:
    """Equal, half-open time bins [start, start + width); time is 0 when the pulse's peak leaves the transmitter."""

    start_ns: float  #: Start of the first bin [ns].
    bin_width_ns: float  #: Width of a bin [ns], positive.
    bin_count: int  #: Number of bins, at least 1.

    @property
    def centres_ns(self) -> FloatArray:
        """Centres of the bins [ns], shape (bin_count,)."""
        return np.asarray(self.start_ns + self.bin_width_ns * (np.arange(self.bin_count) + 0.5))

    @property
    def edges_ns(self) -> FloatArray:
        """Edges of the bins [ns], shape (bin_count + 1,)."""
        return np.asarray(self.start_ns + self.bin_width_ns * np.arange(self.bin_count + 1))

    @property
    def end_ns(self) -> float:
        """End of the last bin [ns]."""
        return self.start_ns + self.bin_width_ns * self.bin_count

    @property
    def path_end(self) -> float:
        """Optical path length of light that arrives at the end of the last bin [m]."""
        return self.end_ns * 1e-9 * C0
