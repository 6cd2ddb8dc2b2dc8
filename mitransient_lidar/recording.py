"""What a render keeps of its passes: histograms and waveforms, or gates alone when memory is short."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mitransient_lidar import results
from mitransient_lidar.accuracy import ErrorGrowth, ErrorWindow, FloatArray, PassStatistics
from mitransient_lidar.errors import UserError
from mitransient_lidar.gating import build_gates, check_train
from mitransient_lidar.optics.gates import GateTrain
from mitransient_lidar.optics.pulse import waveform

if TYPE_CHECKING:
    import xarray as xr

    from mitransient_lidar.transport.system import LidarScene

logger = logging.getLogger(__name__)

#: Memory of a bin [bytes] for the means and errors over the passes, of energy and power, and what they are made with.
_BYTES_PER_KEPT_BIN = 96
#: Memory of a bin when a pass is turned into gates, of a gate that is kept, and of a gate's weight in the film.
_BYTES_PER_PASSING_BIN, _BYTES_PER_KEPT_GATE = 8, 64

#: Pixels from which the error of a gate is taken.
_JUDGED_PIXELS = 4096

#: A pixel is lit in a gate with this share of the energy of the gate's brightest pixels (99th percentile).
_LIT = 0.05


class Recording(ABC):
    """Means and standard errors over the passes of a render.

    Parameters
    ----------
    system
        The lidar scene.
    window
        Bins in which errors count.
    train
        Gates, or None.
    """

    def __init__(self, system: LidarScene, window: ErrorWindow, train: GateTrain | None) -> None:
        self.system, self.window, self.train = system, window, train
        self.gates = PassStatistics()

    @property
    def count(self) -> int:
        """Number of passes."""
        return self.gates.count

    @property
    @abstractmethod
    def received(self) -> float:
        """Energy received in all passes [J]."""

    @abstractmethod
    def add_pass(self) -> None:
        """Add what the film holds."""

    def errors(self) -> FloatArray:
        """Return the relative standard errors by which the render is judged, any number of them.

        Of a gate it is the median over its lit pixels. Gates count whose middle lies between the surface echo and the
        end of the bottom echo of some pixel.
        """
        middles = self._train.middles_ns
        start, end = float(self.window.start_ns.min()), float(self.window.end_ns.max())
        chosen = np.flatnonzero((middles >= start) & (middles <= end))
        found: list[float] = []
        # A sample of the pixels is enough, and ten times as fast.
        sample = slice(None, None, max(1, len(self.gates.mean) // _JUDGED_PIXELS))
        mean, errors = self.gates.mean[sample], self.gates.stderr_of(sample)
        for gate in chosen if chosen.size else range(middles.size):
            energy, stderr = mean[:, gate], errors[:, gate]
            lit = energy > _LIT * np.nanpercentile(energy, 99)
            found.append(float(np.median(stderr[lit] / energy[lit])) if lit.any() else np.inf)
        return np.array(found)

    @abstractmethod
    def dataset(self, attributes: dict[str, Any]) -> xr.Dataset:
        """Return the labelled result."""

    @property
    def _train(self) -> GateTrain:
        assert self.train is not None
        return self.train

    def _gate_stack(self, coords: Mapping[Any, Any], attributes: dict[str, Any]) -> xr.Dataset:
        """Return the gates, labelled."""
        shape = (*(self.system.receiver.pixels.grid or (self.system.receiver.pixels.count,)), self._train.count)
        mean, stderr = (values.reshape(shape) for values in (self.gates.mean, self.gates.stderr))
        if invalid := np.count_nonzero(~np.isfinite(mean).all(axis=-1)):
            logger.warning("gates of %d of %d pixels hold values that are not finite", invalid, mean[..., 0].size)
        return build_gates(mean, stderr, self._train, coords=coords, attributes=attributes)


class WaveformRecording(Recording):
    """Keeps energy and power of every bin, and the gates cut from them."""

    def __init__(self, system: LidarScene, window: ErrorWindow, train: GateTrain | None) -> None:
        super().__init__(system, window, train)
        film = system.film
        film.sum_bins()
        self._kernel = system.transmitter.pulse.kernel(film.bin_width_ns, system.receiver.optics.response_time_ns)
        self._energy, self._power, self._growth = PassStatistics(), PassStatistics(), ErrorGrowth()
        self._weights = None if train is None else _weights(system, train)

    @property
    def count(self) -> int:
        """Number of passes."""
        return self._energy.count

    @property
    def received(self) -> float:
        """Energy received in all passes [J]."""
        return float(np.nansum(self._energy.mean)) * self.count

    def add_pass(self) -> None:
        """Add what the film holds."""
        film = self.system.film
        energy = film.energy().reshape(self.system.receiver.pixels.count, film.bin_count)
        power = waveform(energy, film.bin_width_ns, self._kernel)
        self._energy.add(energy)
        self._power.add(power)
        self._growth.add(power)
        if self._weights is not None:
            self.gates.add(energy @ self._weights)

    def errors(self) -> FloatArray:
        """Return the relative standard errors of the gates, or without any of the bins that count."""
        if self.train is not None:
            return super().errors()
        return self.window.relative_errors(self._power.mean, self._power.stderr)

    def dataset(self, attributes: dict[str, Any]) -> xr.Dataset:
        """Return the labelled result; with gates, they are two more variables."""
        film, pixels = self.system.film, self.system.receiver.pixels
        bins, growth = self._growth.over(self._power.mean, self._power.stderr)
        built = results.build(
            self._energy.mean,
            self._energy.stderr,
            self._power.mean,
            self._power.stderr,
            time_start_ns=film.time_start_ns,
            bin_width_ns=film.bin_width_ns,
            pixel_names=pixels.names,
            pixel_centres_mrad=1e3 * pixels.centres(),
            grid=pixels.grid,
            attributes={**attributes, "error_growth_bins": bins, "error_growth": growth},
        )
        if self.train is None:
            return built
        stack = self._gate_stack(built.coords, dict(built.attrs))
        return built.merge(stack, combine_attrs="override").assign_attrs(stack.attrs)


class GateRecording(Recording):
    """Keeps gates alone, cut from each pass's histogram or summed by the film."""

    def __init__(self, system: LidarScene, window: ErrorWindow, train: GateTrain, direct: bool) -> None:
        super().__init__(system, window, train)
        if direct:
            optics = system.receiver.optics
            system.film.sum_gates(train, train.response_weights(system.transmitter.pulse, optics.response_time_ns))
        else:
            system.film.sum_bins()
        self._weights = None if direct else _weights(system, train).astype(np.float32)

    @property
    def received(self) -> float:
        """Energy in the gates of all passes [J]; where gates overlap it counts more than once."""
        return float(np.nansum(self.gates.mean)) * self.count

    def add_pass(self) -> None:
        """Add what the film holds."""
        film, count = self.system.film, self.system.receiver.pixels.count
        if self._weights is None:
            self.gates.add(film.energy().reshape(count, -1))
        else:
            # The sums of one pass in 32 bits, those over the passes in 64.
            self.gates.add((film.rounded_energy().reshape(count, -1) @ self._weights).astype(np.float64))

    def dataset(self, attributes: dict[str, Any]) -> xr.Dataset:
        """Return the labelled gates."""
        pixels = self.system.receiver.pixels
        coords = results.pixel_coordinates(pixels.names, 1e3 * pixels.centres(), pixels.grid)
        return self._gate_stack(coords, results.provenance(attributes))


def recording_of(
    system: LidarScene, window: ErrorWindow, surface_time_ns: float | None, max_memory: float
) -> Recording:
    """Return the recording that keeps most within the memory.

    Parameters
    ----------
    system
        The lidar scene.
    window
        Bins in which errors count.
    surface_time_ns
        Mean time of the surface echo [ns], from which gates by depth count; None when nothing of it is seen.
    max_memory
        Memory for film, means and errors [GB].

    Raises
    ------
    UserError
        When not even a single gate fits, when a histogram without gates does not, or when gates by depth have no
        surface to count from.
    """
    film, pixels = system.film, system.receiver.pixels.count
    bins, limit = pixels * film.bin_count, 1e9 * max_memory
    train = _placed(system, surface_time_ns, float(window.start_ns.min()))
    film_bytes, gates = film.BYTES_PER_BIN * bins, 0 if train is None else _BYTES_PER_KEPT_GATE * pixels * train.count
    whole = film_bytes + _BYTES_PER_KEPT_BIN * bins + gates
    if whole <= limit:
        return WaveformRecording(system, window, train)
    size = f"the histogram of {pixels} pixels x {film.bin_count} bins takes {1e-9 * whole:.2g} GB"
    if train is None:
        raise UserError(
            f"{size}: more than max_memory = {max_memory:g} GB allows; "
            "take fewer bins or pixels, or gates (gate_count), which do not need it"
        )
    if film_bytes + _BYTES_PER_PASSING_BIN * bins + gates <= limit:
        logger.warning("%s, more than max_memory = %g GB: gates are kept, histograms are not", size, max_memory)
        return GateRecording(system, window, train, direct=False)
    each = (film.BYTES_PER_BIN + _BYTES_PER_KEPT_GATE) * pixels
    if each * train.count > limit:
        fitting = int(limit // each)
        room = f"room for {fitting} of them" if fitting else "less than one gate needs"
        raise UserError(
            f"max_memory = {max_memory:g} GB is {room}: {train.count} gates of {pixels} pixels take "
            f"{1e-9 * each * train.count:.2g} GB, so allow that much, or fewer gates or pixels"
        )
    logger.warning("%s, more than max_memory = %g GB: gates are summed directly", size, max_memory)
    return GateRecording(system, window, train, direct=True)


def _placed(system: LidarScene, surface_time_ns: float | None, start_ns: float) -> GateTrain | None:
    """Return the film's gates at their time, None without any."""
    plan = system.film.gates
    if plan is None:
        return None
    if plan.start_ns is None and surface_time_ns is None:
        raise UserError(
            f"gate_start_depth = {plan.start_depth:g} m counts from the surface echo, and the receiver sees no "
            "surface: give gate_start_ns"
        )
    sine = np.sqrt(max(0.0, 1 - float(system.receiver.pose.axis[2]) ** 2)) / system.refractive_index
    surface = 0.0 if surface_time_ns is None else surface_time_ns
    train: GateTrain = plan.placed(surface, float(system.group_index), float(np.sqrt(1 - sine**2)))
    seen = {} if surface_time_ns is None else {"surface_time_ns": surface, "window_start_ns": float(start_ns)}
    check_train(train, seen, system.film.time_start_ns, system.film.bin_width_ns, system.film.bin_count)
    return train


def _weights(system: LidarScene, train: GateTrain) -> FloatArray:
    """Return the weight of light that arrives in each bin in each gate, pulses included, shape (bin, gate)."""
    film, optics = system.film, system.receiver.optics
    table = train.response_weights(system.transmitter.pulse, optics.response_time_ns)
    times = table.start_ns + table.step_ns * np.arange(table.values.size)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (table.values[1:] + table.values[:-1]) * table.step_ns)])
    edges = film.time_start_ns + film.bin_width_ns * np.arange(film.bin_count + 1)
    shifts = train.step_ns * np.arange(train.count)
    return np.asarray(
        np.diff(np.interp(edges[:, None] - shifts, times, integral), axis=0) * (train.pulses / film.bin_width_ns)
    )
