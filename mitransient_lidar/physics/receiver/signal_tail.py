"""Delayed events of detectors: signal-induced noise and the afterpulses of photomultipliers as a tail of the signal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import Checked, FloatArray, finite_array


@dataclass(frozen=True, kw_only=True)
class SignalTail(Checked):
    """Events that follow those of the light, a sum of decaying exponentials; the default has none.

    Parameters
    ----------
    tail_fractions : tuple of float
        Events of each exponential per event of the light, or charge per charge; at least 0, of a sum of at most 1.
    tail_decays_ns : tuple of float
        Decay time of each exponential [ns], positive.
    tail_delays_ns : tuple of float
        Delay of each exponential's start after the light [ns], at least 0; empty for no delay.

    Notes
    -----
    Delayed events are a Poisson process with the gain, excess noise and shot noise of other events, whose rate is that
    of the light convolved with sum_i f_i exp(-(t - d_i)/tau_i)/tau_i. Behind an echo of peak P and of a duration w (its
    energy over its peak) much shorter than tau, the tail begins at P f w/tau: 1e-3 of the peak for f = 1e-3 tau/w.

    Photomultipliers have such tails by fluorescence of their window and by ions: W. H. Hunt and S. K. Poultney, IEEE
    Trans. Nucl. Sci. 22, 116 (1975), doi:10.1109/TNS.1975.4327627; Y. Zhao, Appl. Opt. 38, 4639 (1999),
    doi:10.1364/AO.38.004639.
    """

    tail_fractions: tuple[float, ...] = ()
    tail_decays_ns: tuple[float, ...] = ()
    tail_delays_ns: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        fractions = _numbers("tail_fractions", self.tail_fractions, 0)
        if fractions.sum() > 1:
            raise UserError(f"tail_fractions = {list(self.tail_fractions)} must have a sum of at most 1")
        decays = _numbers("tail_decays_ns", self.tail_decays_ns, np.finfo(float).tiny)
        delays = _numbers("tail_delays_ns", self.tail_delays_ns, 0)
        for name, values, sizes in (
            ("tail_decays_ns", decays, (fractions.size,)),
            ("tail_delays_ns", delays, (0, fractions.size)),
        ):
            if values.size not in sizes:
                raise UserError(
                    f"{name} = {values.tolist()} must have as many numbers as tail_fractions, {fractions.size}"
                )
        super().__post_init__()

    def with_tail(self, events: FloatArray, steady: FloatArray, part_ns: float) -> FloatArray:
        """Return mean events with the delayed ones.

        Parameters
        ----------
        events : ndarray, shape (..., time)
            Mean events in parts of bins.
        steady : ndarray, shape (..., 1)
            Those of background and dark current alone, which were there long before the record.
        part_ns : float
            Width of the parts [ns].
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


def _numbers(name: str, given: object, least: float) -> FloatArray:
    """Return a list of numbers of at least `least`."""
    if not isinstance(given, tuple | list):
        raise UserError(f"{name} = {given!r} must be a list of numbers")
    values = finite_array(name, given)
    if np.any(values < least):
        raise UserError(f"{name} = {list(given)} must have numbers {'of at least' if least == 0 else 'above'} 0")
    return values
