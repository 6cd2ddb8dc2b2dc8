"""Delayed detector events: signal-induced noise, and photomultiplier afterpulses as a tail of the signal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, positive_option
from mitransient_lidar.core.plans import Plan
from mitransient_lidar.core.validation import FloatArray


@dataclass(frozen=True, kw_only=True)
class SignalTail(Plan):
    """Events that follow light events, as a sum of decaying exponentials; the default has none.

    Notes
    -----
    Delayed events are a Poisson process with the gain, excess noise and shot noise of other events. Their rate is the
    light's rate convolved with sum_i f_i exp(-(t - d_i)/tau_i)/tau_i. After an echo with peak P and a duration w (its
    energy over its peak) much shorter than tau, the tail begins at P f w/tau: 1e-3 times the peak for f = 1e-3 tau/w.

    Photomultipliers have such tails by fluorescence of their window and by ions: W. H. Hunt and S. K. Poultney, IEEE
    Trans. Nucl. Sci. 22, 116 (1975), doi:10.1109/TNS.1975.4327627; Y. Zhao, Appl. Opt. 38, 4639 (1999),
    doi:10.1364/AO.38.004639.
    """

    tail_fractions: Annotated[
        tuple[float, ...],
        Option("Events in each exponential per light event, or charge per charge; their sum is at most 1", 0),
    ] = ()
    tail_decays_ns: Annotated[tuple[float, ...], positive_option("Decay time of each exponential", "ns")] = ()
    tail_delays_ns: Annotated[
        tuple[float, ...], Option("Delay of each exponential's start after the light; empty for no delay", 0, unit="ns")
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        count = len(self.tail_fractions)
        if sum(self.tail_fractions) > 1:
            raise UserError(f"tail_fractions = {list(self.tail_fractions)} must have a sum of at most 1")
        for name, sizes in (("tail_decays_ns", (count,)), ("tail_delays_ns", (0, count))):
            if len(values := getattr(self, name)) not in sizes:
                raise UserError(f"{name} = {list(values)} must have as many numbers as tail_fractions, {count}")

    def with_tail(self, events: FloatArray, steady: FloatArray, part_ns: float) -> FloatArray:
        """Return mean events, including delayed ones.

        Parameters
        ----------
        events : ndarray, shape (..., time)
            Mean events in parts of bins.
        steady : ndarray, shape (..., 1)
            Mean events by background and dark current alone, which were there long before the record.
        part_ns : float
            Part width [ns].
        """
        from scipy.signal import lfilter

        signal = self._tail_sources(events, part_ns) - steady
        total = events + sum(self.tail_fractions) * steady
        delays = self.tail_delays_ns or (0.0,) * len(self.tail_fractions)
        for fraction, decay, delay in zip(self.tail_fractions, self.tail_decays_ns, delays, strict=True):
            # Light within a part is taken at its middle; the exponential is integrated over each later part.
            root = np.exp(-0.5 * part_ns / decay)
            tail = fraction * lfilter([1 - root, root - root**2], [1, -(root**2)], signal, axis=-1)
            parts = int(delay / part_ns)
            later = delay / part_ns - parts
            for shift, share in ((parts, 1 - later), (parts + 1, later)):
                if shift < tail.shape[-1]:
                    total[..., shift:] += share * tail[..., : tail.shape[-1] - shift]
        return np.asarray(total)

    def _tail_sources(self, events: FloatArray, part_ns: float) -> FloatArray:
        """Return the mean events that are followed by delayed ones."""
        return events
