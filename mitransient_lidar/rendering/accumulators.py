"""Accumulation over the passes of a render: histograms and waveforms, or only gates if memory is short."""

from __future__ import annotations

import itertools
import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, require_memory
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.physics.lidar.pulse import waveform
from mitransient_lidar.rendering.accuracy import ErrorCorrelation, ErrorWindow, PassStatistics
from mitransient_lidar.results.gate_stack import add_gate_derivatives, build_gates, check_train
from mitransient_lidar.results.sum_errors import with_correlation

if TYPE_CHECKING:
    import xarray as xr

    from mitransient_lidar.rendering.derivatives import Parameter
    from mitransient_lidar.rendering.differences import Differences
    from mitransient_lidar.transport.histogram import GateWeights, TransientHistogram
    from mitransient_lidar.transport.scene import LidarScene

logger = logging.getLogger(__name__)

#: Memory of a bin [bytes] for the means and errors over the passes, of energy and power, and their computation.
_BYTES_PER_KEPT_BIN = 96
#: Memory of a bin when a pass is converted to gates, and of a gate that is kept, with its weights in the film.
_BYTES_PER_PASSING_BIN, _BYTES_PER_KEPT_GATE = 8, 64
#: Memory of a bin of a batch of passes: its sum, and the mean in the result.
_BYTES_PER_BATCH = 16

#: Pixels from which the error of a gate is estimated.
_ERROR_PIXELS = 4096

#: A pixel is lit in a gate with this share of the energy of the gate's brightest pixels (99th percentile).
_LIT = 0.05


class PassAccumulator(ABC):
    """Means and standard errors over the passes of a render, with gates or without."""

    #: Gates that a pass accumulates instead of time bins, or None.
    gate_weights: GateWeights | None = None

    def __init__(self, scene: LidarScene, window: ErrorWindow, train: GateTrain | None) -> None:
        self.scene, self.window, self.train = scene, window, train
        self.gates = PassStatistics()

    @property
    @abstractmethod
    def received(self) -> float:
        """Energy received in all passes [J]."""

    @property
    @abstractmethod
    def is_empty(self) -> bool:
        """Whether no light was received in any pass; values that are not finite count as light."""

    @abstractmethod
    def add(self, histogram: TransientHistogram) -> None:
        """Add the histogram of a pass."""

    def require_light(self, passes: int) -> None:
        """Raise UserError if the record of all passes is empty."""
        if self.is_empty:
            axis = self.scene.axis
            raise UserError(
                f"no light returned between {axis.start_ns:g} and {axis.end_ns:g} ns in {passes} passes: beam and "
                "field of view must meet on the sea or below it, and the record and its gates must include the echoes"
            )

    def errors(self) -> FloatArray:
        """Return the relative standard errors of which the 95th percentile is compared with the target.

        That of a gate is the median over its lit pixels, for gates with their middle between the surface echo and the
        end of the bottom echo of a pixel.
        """
        middles = self._train.middles_ns
        start, end = float(self.window.start_ns.min()), float(self.window.end_ns.max())
        chosen = np.flatnonzero((middles >= start) & (middles <= end))
        found: list[float] = []
        # A sample of the pixels is ten times as fast.
        sample = slice(None, None, max(1, len(self.gates.mean) // _ERROR_PIXELS))
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
        """Return the labelled gates."""
        pixels = self.scene.receiver.pixels
        shape = (*(pixels.grid or (pixels.count,)), self._train.count)
        mean, stderr = (values.reshape(shape) for values in (self.gates.mean, self.gates.stderr))
        if invalid := np.count_nonzero(~np.isfinite(mean).all(axis=-1)):
            logger.warning("gates of %d of %d pixels hold values that are not finite", invalid, mean[..., 0].size)
        return build_gates(mean, stderr, self._train, coords=coords, attributes=attributes)


class WaveformAccumulator(PassAccumulator):
    """Statistics of energy and power in every bin, and of the gates cut from them."""

    def __init__(
        self,
        scene: LidarScene,
        window: ErrorWindow,
        train: GateTrain | None,
        origins: Sequence[str] = (),
        parameters: Sequence[Parameter] = (),
        differences: Differences | None = None,
        batches: int = 0,
    ) -> None:
        super().__init__(scene, window, train)
        response = scene.receiver.optics.response_time_ns
        self._kernel = scene.transmitter.pulse.kernel(scene.axis.bin_width_ns, response)
        self._energy, self._power, self._correlation = PassStatistics(), PassStatistics(), ErrorCorrelation()
        self._origins, self._parameters = list(origins), list(parameters)
        self._perturbed, self._differences = (PassStatistics(), PassStatistics()), differences
        self._scores = sum(one.perturbation is not None for one in self._parameters)
        self._parts = PassStatistics(), PassStatistics()
        self._batches: list[FloatArray] = [np.zeros(())] * batches  # sums of the power of every batch
        self._weights = None if train is None else _weights(scene, train)
        self._gate_slopes = PassStatistics()
        if differences is not None and train is not None:
            differences.cut(train)

    @property
    def received(self) -> float:
        """Energy received in all passes [J]."""
        return float(np.nansum(self._energy.mean)) * self._energy.count

    @property
    def is_empty(self) -> bool:
        """Whether no light was received in any pass."""
        return not np.any(self._energy.mean)

    def add(self, histogram: TransientHistogram) -> None:
        """Add the histogram of a pass."""
        energy = histogram.energy()
        if self._origins:
            parts = energy.reshape(self.scene.receiver.pixels.count, len(self._origins), -1)
            self._parts[0].add(parts)
            self._parts[1].add(waveform(parts, self.scene.axis.bin_width_ns, self._kernel))
            energy = parts.sum(axis=1)
        if self._scores:
            perturbed, classes = histogram.perturbed(), max(len(self._origins), 1)
            shape = len(perturbed), self.scene.receiver.pixels.count, classes, -1
            perturbed = perturbed.reshape(shape).sum(axis=2)
            self._perturbed[0].add(perturbed)
            self._perturbed[1].add(waveform(perturbed, self.scene.axis.bin_width_ns, self._kernel))
            if self._weights is not None:
                self._gate_slopes.add(perturbed @ self._weights)
        energy = energy.reshape(self.scene.receiver.pixels.count, -1)
        power = waveform(energy, self.scene.axis.bin_width_ns, self._kernel)
        self._energy.add(energy)
        self._power.add(power)
        self._correlation.add(power)
        if self._batches:
            number = (self._power.count - 1) % len(self._batches)
            self._batches[number] = self._batches[number] + power
        if self._weights is not None:
            self.gates.add(energy @ self._weights)

    def errors(self) -> FloatArray:
        """Return the relative standard errors of the gates, or without gates of the bins in the window."""
        if self.train is not None:
            return super().errors()
        return self.window.relative_errors(self._power.mean, self._power.stderr)

    def dataset(self, attributes: dict[str, Any]) -> xr.Dataset:
        """Return the labelled result; gates are two more variables."""
        axis, pixels = self.scene.axis, self.scene.receiver.pixels
        means = self._energy.mean, self._power.mean
        if self._origins:
            # The whole is the sum of its parts to the bit.
            means = tuple(part.mean.sum(axis=1) for part in self._parts)
        built = results.build(
            means[0],
            self._energy.stderr,
            means[1],
            self._power.stderr,
            time=axis,
            pixel_names=pixels.names,
            pixel_centres_mrad=1e3 * pixels.centres(),
            grid=pixels.grid,
            attributes=attributes,
        )
        if (measured := self._correlation.over(built["time"].values)) is not None:
            built = with_correlation(built, *measured)
        if self._origins:
            arrays = (values for part in self._parts for values in (part.mean, part.stderr))
            built = results.add_components(built, self._origins, *arrays)
        if self._parameters:
            about = ([getattr(one, name) for one in self._parameters] for name in ("name", "value", "units", "method"))
            built = results.add_derivatives(built, *about, *self._derivatives())
        if self._batches:
            count, batches = self._power.count, len(self._batches)
            passes = [len(range(number, count, batches)) for number in range(min(batches, count))]
            batch_means = [total / number for total, number in zip(self._batches, passes, strict=False)]
            built = results.add_batches(built, passes, batch_means)
        if self.train is None:
            return built
        stack = self._gate_stack(built.coords, dict(built.attrs))
        if self._parameters:
            stack = add_gate_derivatives(stack, *self._gate_derivatives())
        return built.merge(stack, combine_attrs="override").assign_attrs(stack.attrs)

    def _derivatives(self) -> list[FloatArray]:
        """Return derivatives of energy and power and their standard errors, in the order of the parameters."""
        of_paths = [values for part in self._perturbed for values in (part.mean, part.stderr)] if self._scores else []
        one = self._differences
        others = [] if one is None else [one.impulse_response, one.impulse_response_stderr]
        others += [] if one is None else [one.waveform, one.waveform_stderr]
        return self._joined(of_paths, others)

    def _gate_derivatives(self) -> list[FloatArray]:
        """Return derivatives of the energy in gates and their standard errors, in the order of the parameters."""
        of_paths = [self._gate_slopes.mean, self._gate_slopes.stderr] if self._scores else []
        one = self._differences
        return self._joined(of_paths, [] if one is None else [one.gates, one.gates_stderr])

    def _joined(self, of_paths: Sequence[FloatArray], others: Sequence[FloatArray]) -> list[FloatArray]:
        """Return arrays of the parameters with scores and of the others in the order of the parameters."""
        last = [parameter.perturbation is None for parameter in self._parameters]
        order = np.argsort(np.argsort(last, kind="stable"))
        pairs = itertools.zip_longest(of_paths, others)
        return [np.concatenate([part for part in pair if part is not None])[order] for pair in pairs]


class GateAccumulator(PassAccumulator):
    """Statistics of gates only, cut from the histogram of each pass or accumulated in the pass."""

    def __init__(self, scene: LidarScene, window: ErrorWindow, train: GateTrain, direct: bool) -> None:
        super().__init__(scene, window, train)
        self._weights = None if direct else _weights(scene, train).astype(np.float32)
        if direct:
            from mitransient_lidar.transport.histogram import GateWeights

            response = scene.receiver.optics.response_time_ns
            table = train.response_weights(scene.transmitter.pulse, response)
            self.gate_weights = GateWeights(train, table, scene.reference_length)

    @property
    def received(self) -> float:
        """Energy in the gates of all passes [J], added up where gates overlap."""
        return float(np.nansum(self.gates.mean)) * self.gates.count

    @property
    def is_empty(self) -> bool:
        """Whether no light was received in the gates."""
        return not np.any(self.gates.mean)

    def add(self, histogram: TransientHistogram) -> None:
        """Add the histogram of a pass."""
        count = self.scene.receiver.pixels.count
        if self._weights is None:
            self.gates.add(histogram.energy().reshape(count, -1))
        else:
            # The sums of one pass in 32 bits, those over the passes in 64.
            self.gates.add((histogram.rounded_energy().reshape(count, -1) @ self._weights).astype(np.float64))

    def dataset(self, attributes: dict[str, Any]) -> xr.Dataset:
        """Return the labelled gates."""
        pixels = self.scene.receiver.pixels
        coords = results.pixel_coordinates(pixels.names, 1e3 * pixels.centres(), pixels.grid)
        return self._gate_stack(coords, results.provenance(attributes))


def choose_accumulator(
    scene: LidarScene,
    window: ErrorWindow,
    surface_time_ns: float | None,
    max_memory: float,
    origins: Sequence[str] = (),
    parameters: Sequence[Parameter] = (),
    differences: Differences | None = None,
    batches: int = 0,
) -> PassAccumulator:
    """Return the accumulator of the most quantities for film, means and errors in `max_memory` [GB].

    Depths of gates are relative to the mean time of the surface echo [ns], None without one. Light is separated by
    `origins`, and differentiated by `parameters`, some by `differences`, if there are any. The power of `batches` of
    passes is kept, too.

    Raises
    ------
    UserError
        If a histogram without gates or a single gate exceeds the memory, or gates by depth have no surface.
    """
    from mitransient_lidar.transport.histogram import TransientHistogram

    pixels, per_bin = scene.receiver.pixels.count, TransientHistogram.BYTES_PER_BIN
    each, limit = pixels * scene.axis.bin_count, 1e9 * max_memory
    channels = 1 + len(parameters)
    bins = each * (1 + len(origins)) * channels
    train = _placed(scene, surface_time_ns, float(window.start_ns.min()))
    film_bytes, gates = per_bin * bins, 0 if train is None else _BYTES_PER_KEPT_GATE * pixels * train.count
    everything = film_bytes + _BYTES_PER_KEPT_BIN * bins + _BYTES_PER_BATCH * each * batches + gates
    if everything <= limit:
        require_memory(f"histograms of {pixels} pixels x {scene.axis.bin_count} bins", everything, "take fewer of them")
        return WaveformAccumulator(scene, window, train, origins, parameters, differences, batches)
    size = f"the histogram of {pixels} pixels x {scene.axis.bin_count} bins takes {1e-9 * everything:.2g} GB"
    if origins:
        size = size.replace(" takes", f" x {len(origins)} components takes")
        raise UserError(f"{size}: more than max_memory = {max_memory:g} GB allows; take fewer bins or pixels")
    if batches:
        size = size.replace(" takes", f" with {batches} batches of passes takes")
        raise UserError(f"{size}: more than max_memory = {max_memory:g} GB allows; take fewer of them")
    if channels > 1:
        size = size.replace(" takes", f" x {channels} with derivatives takes")
        raise UserError(f"{size}: more than max_memory = {max_memory:g} GB allows; take fewer of them")
    if train is None:
        raise UserError(
            f"{size}: more than max_memory = {max_memory:g} GB allows; "
            "take fewer bins or pixels, or gates (gate_count), which do not need it"
        )
    if film_bytes + _BYTES_PER_PASSING_BIN * bins + gates <= limit:
        logger.warning("%s, more than max_memory = %g GB: gates are kept, histograms are not", size, max_memory)
        return GateAccumulator(scene, window, train, direct=False)
    each = (per_bin + _BYTES_PER_KEPT_GATE) * pixels
    if each * train.count > limit:
        fitting = int(limit // each)
        room = f"room for {fitting} of them" if fitting else "less than one gate needs"
        raise UserError(
            f"max_memory = {max_memory:g} GB is {room}: {train.count} gates of {pixels} pixels take "
            f"{1e-9 * each * train.count:.2g} GB, so allow that much, or fewer gates or pixels"
        )
    logger.warning("%s, more than max_memory = %g GB: gates are summed directly", size, max_memory)
    return GateAccumulator(scene, window, train, direct=True)


def _placed(scene: LidarScene, surface_time_ns: float | None, start_ns: float) -> GateTrain | None:
    """Return the gates of the scene at their times."""
    plan = scene.gates
    if plan is None:
        return None
    if plan.start_ns is None and surface_time_ns is None:
        raise UserError(
            f"gate_start_depth = {plan.start_depth:g} m counts from the surface echo, and the receiver sees no "
            "surface: give gate_start_ns"
        )
    surface = 0.0 if surface_time_ns is None else surface_time_ns
    train = plan.placed(surface, scene.depth_per_ns)
    echo = {} if surface_time_ns is None else {"surface_time_ns": surface, "window_start_ns": start_ns}
    check_train(train, echo, scene.axis)
    return train


def _weights(scene: LidarScene, train: GateTrain) -> FloatArray:
    """Return the weights of the bins of a scene in gates, shape (bin, gate)."""
    return train.bin_weights(scene.transmitter.pulse, scene.receiver.optics.response_time_ns, scene.axis)
