"""Film plugin ``time_gated_film``: time histograms of every pixel, or what it collects in gates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import finite, non_negative, positive, whole
from mitransient_lidar.optics.gate_shape import GateShape
from mitransient_lidar.optics.gates import GateTrain, ResponseTable, time_of_depth
from mitransient_lidar.optics.water import C0
from mitransient_lidar.transport.opaque import opaque

#: More bins than this do not fit the memory of a laptop.
_LARGEST_FILM = 2**28

_GATE_START = ("gate_start_ns", "gate_start_depth")
_GATE_SHAPE = ("gate_width_ns", "gate_rise_ns", "gate_fall_ns")

#: Weights of a gate below this are left out: beyond 5 standard deviations of a Gaussian pulse.
_SMALLEST_WEIGHT = 1e-7

#: Bits of the coarse sums below the emitted energy, of the fine sums below those, and number of coarse units below
#: which energies are summed finely. Coarse sums hold 64 times what is emitted; fine ones 2^23 of the largest they take.
_COARSE_BITS, _FINE_BITS, _COARSEST_FINE = 57, 32, 2.0**8


@dataclass(frozen=True)
class GatePlan:
    """Gates as a scene asks for them: a start in time or in depth, and the train without it.

    Attributes
    ----------
    start_ns
        When the first gate opens [ns], or None.
    start_depth
        Depth from which an echo comes then [m], or None.
    train
        Shape, step and number of the gates and pulses, starting at 0.
    """

    start_ns: float | None
    start_depth: float | None
    train: GateTrain

    @classmethod
    def from_properties(cls, props: mi.Properties) -> GatePlan | None:
        """Read the parameters of the film; None without gates.

        Raises
        ------
        ValueError
            When one is out of range, or they contradict each other.
        """
        count = whole("gate_count", props.get("gate_count", 0), 0, 100_000)
        given = [
            name for name in (*_GATE_SHAPE, *_GATE_START, "gate_step_ns", "gate_profile", "pulses") if name in props
        ]
        if count == 0:
            for name in given:
                props.mark_queried(name)
            return None
        starts = [name for name in _GATE_START if name in given]
        if len(starts) != 1:
            raise ValueError(f"gate_count = {count} gates need either gate_start_ns or gate_start_depth")
        start = finite(starts[0], props[starts[0]])
        pulses = whole("pulses", props.get("pulses", 1), 1, 10**9)
        if "gate_profile" in props:
            for name in _GATE_SHAPE:
                if name in given:
                    raise ValueError(f"{name} = {props[name]:g} and gate_profile: give one of them")
            profile = GateShape.from_file(str(props["gate_profile"]))
            step = positive("gate_step_ns", props.get("gate_step_ns", profile.width_ns))
            train = GateTrain.measured(profile, 0.0, step, count, pulses)
        else:
            width = positive("gate_width_ns", props.get("gate_width_ns", 10.0))
            rise, fall = (non_negative(name, props.get(name, 0.0)) for name in _GATE_SHAPE[1:])
            step = positive("gate_step_ns", props.get("gate_step_ns", width))
            train = GateTrain(0.0, width, step, count, rise, fall, pulses)
        return cls(*((start, None) if starts[0] == "gate_start_ns" else (None, start)), train)

    def placed(self, surface_time_ns: float, group_index: float, cos_water: float) -> GateTrain:
        """Return the train at its time; the arguments are those of `optics.gates.time_of_depth`."""
        start: Any = self.start_ns
        if start is None:
            start = float(time_of_depth(self.start_depth, surface_time_ns, group_index, cos_water))
        return replace(self.train, start_ns=start)


class TimeGatedFilm(mi.Film):
    r"""Time histogram of received energy, one for each pixel, and gates (``time_gated_film``).

    ===================  =======  ======================================================================================
    Parameter            Type     Meaning
    ===================  =======  ======================================================================================
    time_start_ns        float    Start of the first bin [ns], with 0 when the pulse's peak leaves the transmitter.
                                  Default: 1390
    bin_width_ns         float    Width of a bin [ns], positive. Default: 0.5
    bin_count            integer  Number of bins, 1 to 1 000 000. Default: 320
    gate_count           integer  Number of gates, 0 (none) to 100 000. Default: 0
    gate_start_ns        float    When the first gate opens: half height of its rising edge [ns]
    gate_start_depth     float    Instead: the depth from which an echo comes then [m], on the receiver's axis
    gate_width_ns        float    Time between the half heights of a gate's edges [ns], positive. Default: 10
    gate_step_ns         float    Time from gate to gate [ns], positive. Default: the width
    gate_rise_ns,        float    10-90 % times of raised-cosine edges [ns], 0 (sharp) or more. Default: 0
    gate_fall_ns
    gate_profile         string   Instead of width and edges: file of two columns, time [ns] and transmission 0 to 1
    pulses               integer  Pulses that each gate adds up, 1 to 10^9. Default: 1
    ===================  =======  ======================================================================================

    Bins are half open, [start, start + width). ``develop`` returns the energy [J] of the last pass as a tensor
    (pixel, time), or (row, column, time) for imagers. Sums are kept as whole numbers of two units, so that they do not
    depend on their order: the same seed gives the same bits, and pixels sum exactly to the whole.

    Gates are cut from the waveform, after pulse and response, by ``mitransient_lidar.render``. When the histogram of an
    imager does not fit the memory that it may use, each arrival goes straight to the gates that are open to some of the
    pulse it belongs to, and no histogram is kept; ``bin_width_ns`` and ``bin_count`` then only say when the record
    ends.

    .. code-block:: xml

        <film type="time_gated_film">
            <float name="time_start_ns" value="1390"/>
            <float name="bin_width_ns" value="0.5"/>
            <integer name="bin_count" value="320"/>
        </film>

    .. code-block:: python

        {'type': 'time_gated_film', 'time_start_ns': 1390.0, 'bin_width_ns': 0.5, 'bin_count': 320}
    """

    #: Memory of a bin, or of a gate [bytes]: two sums and a mark.
    BYTES_PER_BIN = 20

    def __init__(self, props: mi.Properties) -> None:
        self.time_start_ns = finite("time_start_ns", props.get("time_start_ns", 1390.0))
        self.bin_width_ns = positive("bin_width_ns", props.get("bin_width_ns", 0.5))
        self.bin_count = whole("bin_count", props.get("bin_count", 320), 1, 1_000_000)
        #: Gates that the scene asks for, or None.
        self.gates = GatePlan.from_properties(props)
        props["width"], props["height"] = self.bin_count, 1
        super().__init__(props)
        self._shape: tuple[int, ...] = (1,)
        self._start = self.time_start_ns * 1e-9 * C0
        self._per_metre = 1 / (self.bin_width_ns * 1e-9 * C0)
        self._units = 1.0, 1.0
        self._gate_weights: _GateWeights | None = None
        self._sums = dr.zeros(mi.Int64, 2 * self.bin_count)
        self._invalid = dr.zeros(mi.UInt32, self.bin_count)

    @property
    def record_length(self) -> int:
        """Number of sums that a pixel has: bins, or gates when these are summed directly."""
        return self.bin_count if self._gate_weights is None else self._gate_weights.count

    @property
    def _count(self) -> int:
        """Number of sums of all pixels."""
        return int(np.prod(self._shape)) * self.record_length

    @property
    def path_end(self) -> float:
        """Optical path length at which the record ends [m]."""
        return (self.time_start_ns + self.bin_width_ns * self.bin_count) * 1e-9 * C0

    def sum_gates(self, train: GateTrain, table: ResponseTable) -> None:
        """Sum the gates of a train directly from now on, and keep no histogram.

        Parameters
        ----------
        train
            Gates.
        table
            Weight of an arrival in the first gate, from `GateTrain.response_weights`.
        """
        self._gate_weights = _GateWeights(train, table)

    def sum_bins(self) -> None:
        """Keep the histogram from now on."""
        self._gate_weights = None

    def prepare_pixels(self, pixel_count: int, emitted: float, grid: tuple[int, int] | None = None) -> None:
        """Clear the histogram and make room for the pixels.

        Parameters
        ----------
        pixel_count
            Number of pixels.
        emitted
            Energy that the laser emits [J]: no bin can receive more.
        grid
            (rows, columns) of an imager, or None.

        Raises
        ------
        ValueError
            When pixels times bins exceed 2^28.
        """
        if pixel_count * self.record_length > _LARGEST_FILM:
            name = "bin_count" if self._gate_weights is None else "gate_count"
            raise ValueError(
                f"{name} = {self.record_length} times {pixel_count} pixels must not exceed {_LARGEST_FILM} in all"
            )
        self._shape = grid or (pixel_count,)
        self._units = emitted * 2.0**-_COARSE_BITS, emitted * 2.0 ** -(_COARSE_BITS + _FINE_BITS)
        self.clear()

    def add_transient(self, pixel: mi.UInt32, path_length: mi.Float, energy: mi.Float, active: mi.Bool) -> None:
        """Add energy [J] that arrives after an optical path of `path_length` metres (group index included)."""
        if self._gate_weights is not None:
            self._gate_weights.add(path_length, energy, active, lambda k, e, on: self._add(pixel, k, e, on))
            return
        position = (path_length - self._start) * self._per_metre
        active = active & (position >= 0) & (position < self.bin_count)
        self._add(pixel, dr.minimum(mi.UInt32(position), self.bin_count - 1), energy, active)

    def _add(self, pixel: mi.UInt32, number: mi.UInt32, energy: mi.Float, active: mi.Bool) -> None:
        """Add energy to bin or gate `number` of a pixel."""
        index = pixel * self.record_length + number
        valid = dr.isfinite(energy)
        dr.scatter(self._invalid, mi.UInt32(1), index, active & ~valid)
        coarse, fine = self._units
        small = energy < _COARSEST_FINE * coarse
        units = mi.Int64(dr.round(energy * dr.select(small, mi.Float(1 / fine), mi.Float(1 / coarse))))
        dr.scatter_add(self._sums, units, index + dr.select(small, mi.UInt32(self._count), 0), active & valid)

    def energy(self) -> np.ndarray:
        """Return the energy [J] of the last pass as float64, shape (pixels, time) or (rows, columns, time).

        With gates instead of times after `sum_gates`. Bins to which something not finite was added are NaN.
        """
        coarse, fine = np.array(self._sums).reshape(2, self._count)
        energy = coarse * self._units[0] + fine * self._units[1]
        energy[np.array(self._invalid) > 0] = np.nan
        return np.asarray(energy.reshape(*self._shape, self.record_length))

    def rounded_energy(self) -> np.ndarray:
        """Return `energy` in 32 bits, at a quarter of the cost."""
        coarse, fine = (mi.Float64(unit) for unit in self._units)
        index = dr.arange(mi.UInt32, self._count)
        sums = (mi.Float64(dr.gather(mi.Int64, self._sums, index + first)) for first in (0, self._count))
        energy = mi.Float(next(sums) * coarse + next(sums) * fine)
        energy = dr.select(self._invalid > 0, dr.nan, energy)
        return np.array(energy).reshape(*self._shape, self.record_length)

    def develop(self, raw: bool = False) -> mi.TensorXf:
        """Return the energy [J] of the last pass, (pixel, time) or (row, column, time)."""
        return mi.TensorXf(self.energy().astype(np.float32))

    def clear(self) -> None:
        """Set all bins to zero."""
        self._sums = dr.zeros(mi.Int64, 2 * self._count)
        self._invalid = dr.zeros(mi.UInt32, self._count)

    def bitmap(self, raw: bool = False) -> mi.Bitmap:
        """Return the histograms as a bitmap, time along x and pixels along y."""
        return mi.Bitmap(mi.TensorXf(self.energy().reshape(-1, self.record_length, 1).astype(np.float32)))

    def write(self, path: str) -> None:
        """Write the bitmap of `bitmap` to an EXR file; ``mitransient_lidar.render`` writes the full stack."""
        self.bitmap().write(path)

    def prepare(self, aovs: list[str]) -> int:
        """Clear the histogram for an integrator that is not a lidar integrator."""
        self.clear()
        return 1

    def base_channels_count(self) -> int:
        """Return 1: energy."""
        return 1

    def put_block(self, block: mi.ImageBlock) -> None:
        """Refuse: image blocks know no time."""
        raise ValueError("time_gated_film records time: use the integrator lidar_volpath")

    def create_block(self, size: object = None, normalize: bool = False, borders: bool = False) -> mi.ImageBlock:
        """Refuse: image blocks know no time."""
        raise ValueError("time_gated_film records time: use the integrator lidar_volpath")

    def schedule_storage(self) -> None:
        """Schedule the histogram for evaluation."""
        dr.schedule(self._sums, self._invalid)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: a changed film is loaded anew."""

    def to_string(self) -> str:
        """Return a description."""
        return (
            f"TimeGatedFilm[time_start_ns={self.time_start_ns:g}, bin_width_ns={self.bin_width_ns:g}, "
            f"bin_count={self.bin_count}]"
        )


class _GateWeights:
    """Shares arrivals among the gates that are open to some of their pulse."""

    def __init__(self, train: GateTrain, table: ResponseTable) -> None:
        self.count = train.count
        kept = np.flatnonzero(table.values > _SMALLEST_WEIGHT)
        first, last = max(int(kept[0]) - 1, 0), min(int(kept[-1]) + 2, table.values.size)
        # Zero at both ends, so that linear interpolation never leaves the table.
        values = np.append(table.values[first:last], 0.0)
        values[0] = 0.0
        self._values = mi.Float(values)
        self._last = values.size - 2
        self._start = opaque((table.start_ns + first * table.step_ns) * 1e-9 * C0)
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
        """Call `add` with every gate that an arrival counts in and its share of the energy."""
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


mi.register_film("time_gated_film", lambda props: TimeGatedFilm(props))
