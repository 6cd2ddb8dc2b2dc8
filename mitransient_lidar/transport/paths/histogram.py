"""Sums of received energy over one pass, by pixel and time bin or by pixel and gate."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GateTrain, ResponseTable
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.transport.opaque import aligned, opaque, opaque_index
from mitransient_lidar.transport.perturbations import Perturbations, Sums

_LARGEST = 2**28  #: Largest number of sums: more do not fit a laptop's memory.

#: Share of a gate's largest weight below which others are neglected: 5 standard deviations of a Gaussian pulse.
_SMALLEST_WEIGHT = 1e-7

#: Bits of the coarse sums below the emitted energy, bits of the fine sums below those, and number of coarse units below
#: which energies go to the fine sums. Coarse sums can reach 64 times the emitted energy, fine ones 2^23 of their
#: largest terms.
_COARSE_BITS, _FINE_BITS, _COARSEST_FINE = 57, 32, 2.0**8


class GateWeights:
    """Weights of an arrival in the gates that are open during its pulse.

    `table` contains an arrival's weight in the first gate of `train`, from `GateTrain.response_weights`. Path lengths
    are relative to `reference_length` [m].
    """

    def __init__(self, train: GateTrain, table: ResponseTable, reference_length: float = 0.0) -> None:
        self.count = train.count
        kept = np.flatnonzero(table.values > _SMALLEST_WEIGHT * table.values.max())
        first, last = max(int(kept[0]) - 1, 0), min(int(kept[-1]) + 2, table.values.size)
        # Zero at both ends, so that linear interpolation never leaves the table.
        values = np.append(table.values[first:last], 0.0)
        values[0] = 0.0
        self._values = aligned(mi.Float, values)
        self._last = values.size - 2
        self._start = opaque((table.start_ns + first * table.step_ns) * 1e-9 * C0 - reference_length)
        self._per_metre = opaque(1 / (table.step_ns * 1e-9 * C0))
        self._per_gate = opaque(train.step_ns / table.step_ns)
        self._pulses = float(train.pulses)

    def add(
        self,
        path_length: mi.Float,
        energy: mi.Float,
        active: mi.Bool,
        add: Callable[[mi.UInt32, mi.Float, mi.Bool], None],
    ) -> None:
        """Call `add` with every gate in which an arrival counts, and its share of the energy."""
        position = (path_length - self._start) * self._per_metre
        latest = dr.floor(position / self._per_gate)
        earliest = dr.ceil((position - self._last) / self._per_gate)
        active = active & (latest >= 0) & (earliest < self.count)
        gate = mi.UInt32(dr.maximum(earliest, 0))
        end = dr.select(active, mi.UInt32(dr.clip(latest, 0, self.count - 1)) + 1, 0)

        def share(gate: mi.UInt32) -> tuple[mi.UInt32]:
            here = dr.clip(position - mi.Float(gate) * self._per_gate, 0, self._last)
            below = mi.UInt32(here)
            low, high = (dr.gather(mi.Float, self._values, below + step) for step in (0, 1))
            add(gate, energy * self._pulses * dr.lerp(low, high, here - mi.Float(below)), gate < end)
            return (gate + 1,)

        dr.while_loop((gate,), lambda gate: gate < end, share, label="gates")


class TransientHistogram:
    """Each pixel's energy in each time bin, or in each gate, and its perturbations.

    Energies are summed as integers of two units, so that the sums do not depend on their order.

    Raises UserError when pixels times bins, or pixels times gates, with the perturbations exceed 2^28.

    `axis`: time bins of the record. `shape`: numbers of pixels, (pixels,) or (rows, columns). `emitted`: energy that
    the laser emits [J], the most that a bin receives. `gates`: gates that are summed instead of the time bins, or None.
    `reference_length`: length that is left out of path lengths [m], so that they are accurate in single precision.
    `perturbations`: perturbations, each of which is summed as the energies are.
    """

    #: Memory per bin, or per gate [bytes]: two sums and a mark.
    BYTES_PER_BIN = 20

    def __init__(
        self,
        axis: TimeAxis,
        shape: tuple[int, ...],
        emitted: float,
        gates: GateWeights | None = None,
        reference_length: float = 0.0,
        perturbations: Perturbations | None = None,
    ) -> None:
        self.axis, self.gates, self.perturbations = axis, gates, perturbations or Perturbations()
        #: Sums per pixel: time bins, or gates.
        self.record_length = axis.bin_count if gates is None else gates.count
        pixels = int(np.prod(shape))
        channels = 1 + self.perturbations.count
        if pixels * self.record_length * channels > _LARGEST:
            name = "bin_count" if gates is None else "gate_count"
            derivatives = f" times {channels} with the derivatives" if channels > 1 else ""
            raise UserError(
                f"{name} = {self.record_length} times {pixels} pixels{derivatives} must not exceed {_LARGEST} in all"
            )
        #: Shape of `energy`: pixels, then time bins or gates.
        self.shape = (*shape, self.record_length)
        self._each = pixels * self.record_length
        self._count = channels * self._each
        # A last sum contains the loss.
        sizes = self.record_length, self.record_length - 1, self._count, self._count + 1
        self._length, self._last, self._lost, self._fine_sums = map(opaque_index, sizes)
        self._start = opaque(axis.start_ns * 1e-9 * C0 - reference_length)
        self._per_metre = opaque(1 / (axis.bin_width_ns * 1e-9 * C0))
        self._units = emitted * 2.0**-_COARSE_BITS, emitted * 2.0 ** -(_COARSE_BITS + _FINE_BITS)
        self._per_emitted = opaque(1 / emitted)
        self.clear()

    def clear(self) -> None:
        """Set all sums to zero."""
        # Kernels are compiled for the sizes of small arrays to which they add: records with similar lengths share them.
        size = 2 * (self._count + 1)
        self._sums = dr.zeros(mi.Int64, 1 << (size - 1).bit_length() if size < dr.expand_threshold() else size)
        # Marks for energies and perturbations that are not finite.
        self._invalid = dr.zeros(mi.UInt32, self._each * (2 if self.perturbations.count else 1))

    def evaluate(self) -> None:
        """Compute the sums."""
        dr.eval(self._sums, self._invalid)

    def add(
        self, pixel: mi.UInt32, path_length: mi.Float, energy: mi.Float, active: mi.Bool, sums: Sums | None = None
    ) -> None:
        """Add energy [J] that arrives after an optical path (group index included) of a relative length [m].

        `sums` are the perturbation sums along the paths.
        """
        sums = sums or []
        if self.gates is not None:
            self.gates.add(path_length, energy, active, lambda k, e, on: self.add_at(pixel, k, e, on, sums))
            return
        position = (path_length - self._start) * self._per_metre
        active = active & (position >= 0) & (position < mi.Float(self._length))
        self.add_at(pixel, dr.minimum(mi.UInt32(position), self._last), energy, active, sums)

    def add_at(self, pixel: mi.UInt32, number: mi.UInt32, energy: mi.Float, active: mi.Bool, sums: Sums) -> None:
        """Add energy to time bin or gate `number` of a pixel."""
        index = pixel * self._length + number
        valid = dr.isfinite(energy)
        # Another kind of writing would end the kernel of the energies before.
        dr.scatter_reduce(dr.ReduceOp.Or, self._invalid, mi.UInt32(1), index, active & ~valid)
        self._add_share(index, energy, active & valid)
        if not sums:
            return
        perturbed = self.perturbations.channels(energy, sums)
        finite = valid & dr.isfinite(sum(perturbed, mi.Float(0)))
        marked = index + opaque_index(self._each)
        dr.scatter_reduce(dr.ReduceOp.Or, self._invalid, mi.UInt32(1), marked, active & ~finite)
        for channel, change in enumerate(perturbed, 1):
            self._add_share(index + channel * opaque_index(self._each), change, active & finite)

    def lose(self, energy: mi.Float, active: mi.Bool) -> None:
        """Add energy [J] that is lost because the surface mesh ends."""
        self._add_share(self._lost, energy, active & dr.isfinite(energy))

    @property
    def lost(self) -> float:
        """Energy that is lost because the surface mesh ends [J]."""
        return float(self._both_sums()[:, -1] @ np.array(self._units))

    def _add_share(self, index: mi.UInt32, energy: mi.Float, active: mi.Bool) -> None:
        # Units themselves are too small for single precision where pulses are weak.
        share = energy * self._per_emitted
        small = (dr.abs(share) if self.perturbations.count else share) < _COARSEST_FINE * 2.0**-_COARSE_BITS
        units = mi.Int64(dr.round(share * dr.select(small, 2.0 ** (_COARSE_BITS + _FINE_BITS), 2.0**_COARSE_BITS)))
        dr.scatter_add(self._sums, units, index + dr.select(small, self._fine_sums, 0), active)

    def energy(self) -> np.ndarray:
        """Return the energy [J] as float64, shape `shape`; NaN where a value was added that is not finite."""
        return np.asarray(self._channels(slice(0, 1))[0])

    def energy_of(self, pixels: slice) -> np.ndarray:
        """Return `energy` of some pixels in a pixel row, shape (pixels, bins), without other arrays for all."""
        shape = (-1, self.record_length)
        coarse, fine = (
            self._sums.numpy()[first : first + self._each].reshape(shape)[pixels] * unit
            for first, unit in zip((0, self._count + 1), self._units, strict=True)
        )
        found = np.asarray(coarse + fine)
        found[self._invalid.numpy()[: self._each].reshape(shape)[pixels] > 0] = np.nan
        return found

    def perturbed(self) -> np.ndarray:
        """Return the derivatives of the energy, or the perturbed energies, shape (perturbation, *shape)."""
        return self._channels(slice(1, None))

    def _channels(self, chosen: slice) -> np.ndarray:
        """Return energies or their derivatives as float64, shape (channel, *shape)."""
        sums = self._both_sums()[:, :-1].reshape(2, -1, self._each)[:, chosen]
        found = sums[0] * self._units[0] + sums[1] * self._units[1]
        invalid = self._invalid.numpy().reshape(-1, self._each) > 0
        found[:, invalid[0 if chosen.start == 0 else -1]] = np.nan
        return np.asarray(found.reshape(-1, *self.shape))

    def _both_sums(self) -> np.ndarray:
        """Return coarse and fine sums, shape (2, sums + 1)."""
        # A view on the processor: copies of large images took as much memory as they do.
        return np.asarray(self._sums.numpy()[: 2 * (self._count + 1)].reshape(2, -1))

    def rounded_energy(self) -> np.ndarray:
        """Return `energy` as float32, at a quarter of the cost."""
        coarse, fine = (mi.Float64(unit) for unit in self._units)
        index = dr.arange(mi.UInt32, self._each)
        sums = (mi.Float64(dr.gather(mi.Int64, self._sums, index + first)) for first in (0, self._count + 1))
        energy = mi.Float(next(sums) * coarse + next(sums) * fine)
        energy = dr.select(dr.gather(mi.UInt32, self._invalid, index) > 0, dr.nan, energy)
        return np.array(energy).reshape(self.shape)
