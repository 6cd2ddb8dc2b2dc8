"""Accumulation over a render's passes: histograms and waveforms, or only gates if memory is short."""

from __future__ import annotations

import functools
import itertools
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, require_memory
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.rendering import accuracy
from mitransient_lidar.rendering.derivatives import Differences, Parameter
from mitransient_lidar.results.attributes import label
from mitransient_lidar.results.gate_stack import add_gate_derivatives, build_gates, check_train
from mitransient_lidar.results.sum_errors import with_correlation
from mitransient_lidar.transport.paths.histogram import GateWeights, TransientHistogram
from mitransient_lidar.transport.scene import LidarScene

logger = logging.getLogger(__name__)

#: Memory per bin [bytes] for means and errors over the passes, of energy and power, and their computation.
_BYTES_PER_KEPT_BIN = 96
#: Memory per bin when a pass is converted to gates, per gate kept then, and per gate summed directly.
_BYTES_PER_PASSING_BIN, _BYTES_PER_KEPT_GATE, _BYTES_PER_DIRECT_GATE, _BYTES_PER_SMOOTHED_GATE = 8, 64, 18, 24
#: Memory of the program, and its means and errors per pixel, and per gate that is summed directly, in all passes and
#: when it is written, for images.
_PROGRAM, _BYTES_PER_PIXEL, _BYTES_OF_MEANS, _BYTES_PER_WRITTEN_GATE = 0.31e9, 260.0, 16, 6
_MOST_TILES = 64  #: Most tiles of an image.
_BYTES_PER_BATCH = 16  #: Memory per bin in a batch of passes: its sum, and the mean in the result.
_ERROR_PIXELS = 4096  #: Pixels from which the error of a gate is estimated.

#: Smallest path share in a pass with smoothed images: with fewer, paths take little of the time.
_LEAST_SHARE_OF_SMOOTH = 2**-3

_SUMMED = 2**23  #: Values that are summed at a time.

#: A pixel is lit in a gate with this share of the energy in the gate's brightest pixels (99th percentile).
_LIT = 0.05


class Light:
    """Passes' light: the whole, its parts by origin, and perturbed by parameters.

    Energies have the shape (pixels, origins, bins), or for several shots (shots, pixels, origins, bins).
    """

    def __init__(self, scene: LidarScene, separate: bool) -> None:
        self._scene, self._separate = scene, separate
        self.whole, self.parts, self.perturbed = (
            accuracy.LightStatistics(),
            accuracy.LightStatistics(),
            accuracy.LightStatistics(),
        )

    def add(self, energy: FloatArray, perturbed: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Add one pass's energies [J], and perturbed ones with one axis more; return the whole and its power."""
        whole = energy.sum(axis=-2)
        if self._separate:
            power_of_parts = self._power_of(energy)
            self.parts.add(energy, power_of_parts)
        # Many shots share the convolutions of their parts.
        shared = self._separate and energy.ndim > 3
        power = power_of_parts.sum(axis=-2) if shared else self._power_of(whole)
        self.whole.add(whole, power)
        if perturbed is not None:
            changed = perturbed.sum(axis=-2)
            self.perturbed.add(changed, self._power_of(changed))
        return whole, power

    @functools.cached_property
    def _power_of(self) -> Callable[[FloatArray], FloatArray]:
        """Power [W] of energies [J per bin], after the pulse and the receiver's response."""
        return accuracy.received_power(self._scene)

    @property
    def arrays(self) -> tuple[FloatArray, ...]:
        """Mean energy [J] and power [W] of the whole, each with its standard error, as in `LightStatistics`."""
        mean, error, power, power_error = self.whole.arrays
        if self._separate:
            # The whole is the sum of its parts to the bit.
            mean, power = (part.mean.sum(axis=-2) for part in (self.parts.energy, self.parts.power))
        return mean, error, power, power_error


class PassAccumulator:
    """Means and standard errors over a render's passes: all light, or gates alone.

    `scene`, `window`: the scene, and the bins whose errors count. `train`: gates at their times, or None. `origins`:
    names for the separated light origins. `parameters`, `differences`: parameters by which light is differentiated, and
    the subset with central differences. `batches`: number of pass batches whose power is kept. `kept`: whether
    ``histograms`` are kept, ``gates`` are cut from each pass histogram, or ``direct``: accumulated in the pass.
    `smooth`: standard deviation by which each gate's image is smoothed [pixels], or None. `size`: memory of film, means
    and errors, for images of the whole render [bytes]; 0 if it is unknown. `tiles`: tiles of pixels whose ``direct``
    gates are accumulated in turn in each pass, or one None for all pixels.
    """

    def __init__(
        self,
        scene: LidarScene,
        window: accuracy.ErrorWindow,
        train: GateTrain | None = None,
        origins: Sequence[str] = (),
        parameters: Sequence[Parameter] = (),
        differences: Differences | None = None,
        batches: int = 0,
        kept: Literal["histograms", "gates", "direct"] = "histograms",
        smooth: float | None = None,
        size: float = 0.0,
        tiles: Sequence[range | None] = (None,),
    ) -> None:
        self.scene, self.window, self.train, self._kept, self._smooth = scene, window, train, kept, smooth
        self._light, self._correlation = Light(scene, bool(origins)), accuracy.ErrorCorrelation()
        self._origins, self._parameters = list(origins), list(parameters)
        self._scores = sum(one.perturbation is not None for one in self._parameters)
        self._differences = differences
        self._batches: list[FloatArray] = [np.zeros(())] * batches  # power sums of every batch
        self.gates, self._gate_slopes = accuracy.PassStatistics(), accuracy.PassStatistics()
        self.size, self.tiles = size, tiles
        #: Gates that a pass accumulates instead of time bins, or None.
        self.gate_weights: GateWeights | None = None
        self._weights: FloatArray | None = None
        #: Whether a pass accumulates the gates beside time bins, since the bins are longer.
        self.gates_beside = train is not None and kept == "histograms" and train.width_ns < scene.axis.bin_width_ns
        if train is None:
            return
        pulse, response = scene.transmitter.pulse, scene.receiver.optics.response_time_ns
        if kept == "direct" or self.gates_beside:
            self.gate_weights = GateWeights(train, train.response_weights(pulse, response), scene.reference_length)
        else:
            # Bin weights in gates, shape (bin, gate).
            weights = train.bin_weights(pulse, response, scene.axis)
            self._weights = weights if kept == "histograms" else weights.astype(np.float32)
        if differences is not None:
            differences.cut(train)

    @property
    def _received(self) -> accuracy.PassStatistics:
        """Statistics for all kept energy; energy in overlapping gates is added up."""
        return self._light.whole.energy if self._kept == "histograms" else self.gates

    @property
    def received(self) -> float:
        """Energy received in all passes, or in their gates [J]."""
        mean = self._received.mean
        # In parts, of which each is copied.
        parts = np.array_split(mean, max(mean.size // _SUMMED, 1)) if mean.ndim else [mean]
        return float(sum(np.nansum(part) for part in parts)) * self._received.count

    def add(
        self, histogram: TransientHistogram, gated: TransientHistogram | None = None, tile: range | None = None
    ) -> None:
        """Add a pass histogram, of all pixels or of one tile after the other, and its gates accumulated beside it."""
        pixels, classes = self.scene.receiver.pixels.count, max(len(self._origins), 1)
        if self._kept == "direct" and self._smooth:
            self.gates.add(self._smoothed(histogram.energy().reshape(pixels, -1)))
            return
        if self._kept == "direct":
            self.gates.add_parts((pixels, histogram.record_length), histogram.energy_of, tile)
            return
        if self._kept == "gates":
            assert self._weights is not None
            # The sums of one pass in 32 bits, those over the passes in 64.
            energy = (histogram.rounded_energy().reshape(pixels, -1) @ self._weights).astype(np.float64)
            self.gates.add(self._smoothed(energy) if self._smooth else energy)
            return
        perturbed = None
        if self._scores:
            perturbed = histogram.perturbed()
            perturbed = perturbed.reshape(len(perturbed), pixels, classes, -1)
            if self._weights is not None:
                self._gate_slopes.add(perturbed[: self._scores].sum(axis=2) @ self._weights)
            elif gated is not None:
                slopes = gated.perturbed().reshape(len(perturbed), pixels, classes, -1)
                self._gate_slopes.add(slopes[: self._scores].sum(axis=2))
        energy, power = self._light.add(histogram.energy().reshape(pixels, classes, -1), perturbed)
        self._correlation.add(power)
        if self._batches:
            number = (self._light.whole.power.count - 1) % len(self._batches)
            self._batches[number] = self._batches[number] + power
        if gated is not None:
            self.gates.add(gated.energy().reshape(pixels, classes, -1).sum(axis=1))
        elif self._weights is not None:
            self.gates.add(energy @ self._weights)

    def _smoothed(self, energy: FloatArray) -> FloatArray:
        """Return energies, shape (pixels, gates), after smoothing each gate's image, which keeps their sum."""
        from scipy.ndimage import gaussian_filter

        grid = self.scene.receiver.pixels.grid
        assert grid is not None
        smoothed = gaussian_filter(energy.reshape(*grid, -1), self._smooth, axes=(0, 1))
        return np.asarray(smoothed.reshape(energy.shape))

    def _smoothing_bias(self) -> FloatArray:
        """Return each gate's bias by smoothing, rms over its lit pixels, shape (gates,); NaN if unknown."""
        energy, stderr = self.gates.mean, self.gates.stderr
        change = self._smoothed(energy) - energy
        lit = energy > _LIT * np.nanpercentile(energy, 99, axis=0)
        return accuracy.smoothing_bias(change, stderr, energy, lit)

    def require_light(self, passes: int) -> None:
        """Raise UserError if all passes' record is empty; values that are not finite count as light."""
        if not np.any(self._received.mean):
            axis = self.scene.axis
            raise UserError(
                f"no light returned between {axis.start_ns:g} and {axis.end_ns:g} ns in {passes} passes: beam and "
                "field of view must meet on the sea or below it, and the record and its gates must include the echoes"
            )

    def errors(self) -> FloatArray:
        """Return the bins' or gates' relative standard errors whose quantile is compared with the target.

        A gate's error is the median over its lit pixels. Gates count whose middle is between a pixel's surface echo and
        its bottom echo's end.
        """
        if self.train is None:
            return self.window.relative_errors(self._light.whole.power.mean, self._light.whole.power.stderr)
        middles = self.train.middles_ns
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

    def dataset(self, attributes: dict[str, Any]) -> xr.Dataset:
        """Return the labelled result; gates are two more variables, or all."""
        pixels = self.scene.receiver.pixels
        if self._kept != "histograms":
            coords = results.pixel_coordinates(pixels.names, 1e3 * pixels.centres(), pixels.grid)
            return self._gate_stack(coords, results.provenance(attributes))
        built = results.build(
            *self._light.arrays,
            time=self.scene.axis,
            pixel_names=pixels.names,
            pixel_centres_mrad=1e3 * pixels.centres(),
            grid=pixels.grid,
            attributes=attributes,
        )
        if (measured := self._correlation.over(built["time"].values)) is not None:
            built = with_correlation(built, *measured)
        if self._origins:
            built = results.add_components(built, self._origins, *self._light.parts.arrays)
        perturbed = self._light.perturbed.arrays
        if self._parameters:
            of_paths = [values[: self._scores] for values in perturbed] if self._scores else []
            others = () if self._differences is None else self._differences.light.arrays
            built = results.add_derivatives(built, *described(self._parameters), *self._joined(of_paths, others))
        if self._batches:
            count, batches = self._light.whole.power.count, len(self._batches)
            passes = [len(range(number, count, batches)) for number in range(min(batches, count))]
            batch_means = [total / number for total, number in zip(self._batches, passes, strict=False)]
            built = results.add_batches(built, passes, batch_means)
        if self.train is None:
            return built
        stack = self._gate_stack(built.coords, dict(built.attrs))
        if self._parameters:
            of_paths = [self._gate_slopes.mean, self._gate_slopes.stderr] if self._scores else []
            differences = self._differences
            others = () if differences is None else (differences.gates.mean, differences.gates.stderr)
            stack = add_gate_derivatives(stack, *self._joined(of_paths, others))
        return built.merge(stack, combine_attrs="override").assign_attrs(stack.attrs)

    def _gate_stack(self, coords: Mapping[Any, Any], attributes: dict[str, Any]) -> xr.Dataset:
        """Return the labelled gates."""
        assert self.train is not None
        pixels = self.scene.receiver.pixels
        shape = (*(pixels.grid or (pixels.count,)), self.train.count)
        # A coordinate, which all files hold.
        bias = {"gate_smoothing_bias": ("gate", self._smoothing_bias())} if self._smooth else {}
        mean, stderr = (values.reshape(shape) for values in (self.gates.mean, self.gates.pop_stderr()))
        if invalid := np.count_nonzero(~np.isfinite(mean).all(axis=-1)):
            logger.warning("gates of %d of %d pixels hold values that are not finite", invalid, mean[..., 0].size)
        stack = build_gates(mean, stderr, self.train, coords=coords, attributes=attributes)
        return label(stack.assign_coords(bias))

    def _joined(self, of_paths: Sequence[FloatArray], others: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the arrays for parameters with scores and for the others in parameter order."""
        last = [parameter.perturbation is None for parameter in self._parameters]
        order = np.argsort(np.argsort(last, kind="stable"))
        pairs = itertools.zip_longest(of_paths, others)
        return [np.concatenate([part for part in pair if part is not None])[order] for pair in pairs]


def described(parameters: Sequence[Parameter]) -> list[list[Any]]:
    """Return parameters' names, values, units and methods, as `results.add_derivatives` takes them."""
    return [[getattr(one, name) for one in parameters] for name in ("name", "value", "units", "method")]


def choose_accumulator(
    scene: LidarScene,
    window: accuracy.ErrorWindow,
    surface_time_ns: float | None,
    max_memory: float,
    origins: Sequence[str] = (),
    parameters: Sequence[Parameter] = (),
    differences: Differences | None = None,
    batches: int = 0,
    smooth: float | None = None,
    of_pass: tuple[float, float] = (0.0, 0.0),
) -> PassAccumulator:
    """Return the accumulator for the most quantities whose film, means and errors fit in `max_memory` [GB].

    For images, program, paths (`of_pass`, as of `PassRenderer.memory`) and files count, too. Where direct gates exceed
    the memory, each pass accumulates tiles of pixels in turn.

    Gate depths are relative to the surface echo's mean time [ns], None without one. Light is separated by `origins`,
    and differentiated by `parameters`, some by `differences`, if there are any. The power in `batches` pass batches is
    kept, too. With a standard deviation [pixels], gate images are smoothed and nothing else is kept.

    Raises UserError if images without rows, columns or gates would be smoothed, a histogram without gates or a single
    gate exceeds the memory, or gates by depth have no surface.
    """
    pixels, per_bin = scene.receiver.pixels.count, TransientHistogram.BYTES_PER_BIN
    is_image = scene.receiver.is_imager and not smooth
    program = _PROGRAM + _BYTES_PER_PIXEL * pixels if is_image else 0.0
    beside = program + of_pass[0] + of_pass[1] * pixels if is_image else 0.0
    each, limit = pixels * scene.axis.bin_count, 1e9 * max_memory - beside
    channels = 1 + len(parameters)
    bins = each * (1 + len(origins)) * channels
    train = placed_gates(scene, surface_time_ns, float(window.start_ns.min()))
    film_bytes, gates = per_bin * bins, 0 if train is None else _BYTES_PER_KEPT_GATE * pixels * train.count
    everything = film_bytes + _BYTES_PER_KEPT_BIN * bins + _BYTES_PER_BATCH * each * batches + gates
    if smooth and (train is None or scene.receiver.pixels.grid is None):
        raise UserError(f"smooth = {smooth:g} pixels needs gates in the film, and a layout of rows and columns")
    if everything <= limit and not smooth:
        require_memory(f"histograms of {pixels} pixels x {scene.axis.bin_count} bins", everything, "take fewer of them")
        kept = origins, parameters, differences, batches
        return PassAccumulator(scene, window, train, *kept, size=everything + beside)
    cure = "take fewer of them"
    if origins:
        of_what, cure = f" x {len(origins)} components", "take fewer bins or pixels"
    elif batches:
        of_what = f" with {batches} batches of passes"
    elif channels > 1:
        of_what = f" x {channels} with derivatives"
    else:
        of_what, cure = "", "take fewer bins or pixels, or gates (gate_count), which do not need it"
    taken = f"{1e-9 * (everything + beside):.2g} GB"
    size = f"the histogram of {pixels} pixels x {scene.axis.bin_count} bins{of_what} takes {taken}"
    if of_what or train is None:
        raise UserError(f"{size}: more than max_memory = {max_memory:g} GB allows; {cure}")
    is_narrow = train.width_ns < scene.axis.bin_width_ns
    if film_bytes + _BYTES_PER_PASSING_BIN * bins + gates <= limit and not is_narrow:
        if not smooth:
            logger.warning("%s, more than max_memory = %g GB: gates are kept, histograms are not", size, max_memory)
        size_of_gates = film_bytes + _BYTES_PER_PASSING_BIN * bins + gates + beside
        return PassAccumulator(scene, window, train, kept="gates", smooth=smooth, size=size_of_gates)
    if is_image:
        logger.warning("%s, more than max_memory = %g GB: gates are summed directly", size, max_memory)
        needed, tiles = _tiles(pixels, train.count, program, of_pass, max_memory)
        return PassAccumulator(scene, window, train, kept="direct", size=needed, tiles=tiles)
    each = (per_bin + _BYTES_PER_DIRECT_GATE + (_BYTES_PER_SMOOTHED_GATE if smooth else 0)) * pixels
    if each * train.count > limit:
        fitting = int(limit // each)
        room = f"room for {fitting} of them" if fitting else "less than one gate needs"
        raise UserError(
            f"max_memory = {max_memory:g} GB is {room}: {train.count} gates of {pixels} pixels take "
            f"{1e-9 * each * train.count:.2g} GB, so allow that much, or fewer gates or pixels"
        )
    if not smooth:
        logger.warning("%s, more than max_memory = %g GB: gates are summed directly", size, max_memory)
    return PassAccumulator(scene, window, train, kept="direct", smooth=smooth, size=each * train.count)


def _tiles(
    pixels: int, gates: int, program: float, of_pass: tuple[float, float], max_memory: float
) -> tuple[float, list[range | None]]:
    """Return the memory of an image's render and its files [bytes], and the tiles of pixels in its passes.

    Raises UserError if means, errors and small tiles exceed `max_memory` [GB].
    """
    kept = program + _BYTES_OF_MEANS * pixels * gates
    passing, per_pixel = kept + of_pass[0], of_pass[1] + TransientHistogram.BYTES_PER_BIN * gates
    written, limit = kept + _BYTES_PER_WRITTEN_GATE * pixels * gates, 1e9 * max_memory
    most = int(min((limit - passing) // per_pixel, pixels))
    least = max(passing + per_pixel * pixels / _MOST_TILES, written)
    if least > limit:
        raise UserError(
            f"max_memory = {max_memory:g} GB is less than {gates} gates of {pixels} pixels take with the program, "
            f"{1e-9 * least:.3g} GB: allow that much, or take fewer gates or pixels"
        )
    size = math.ceil(pixels / math.ceil(pixels / most))
    tiles: list[range | None] = [range(first, min(first + size, pixels)) for first in range(0, pixels, size)]
    return max(passing + per_pixel * size, written), tiles if len(tiles) > 1 else [None]


def share_of_pass(smooth: float) -> float:
    """Return a pass's path share with smoothed images: about one divided by the number of averaged pixels."""
    return float(np.clip(2.0 ** -np.round(np.log2(4 * np.pi * smooth**2)), _LEAST_SHARE_OF_SMOOTH, 1))


def placed_gates(scene: LidarScene, surface_time_ns: float | None, start_ns: float) -> GateTrain | None:
    """Return the scene's gates at their times."""
    if scene.gates is None:
        return None
    train = scene.gate_train(scene.gates)
    no_echo = surface_time_ns is None or scene.submerged
    echo = {} if no_echo else {"surface_time_ns": surface_time_ns, "window_start_ns": start_ns}
    check_train(train, echo, scene.axis)
    return train
