"""Film plugin ``time_gated_film``: the time axis of a record, and its gates."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.ranges import ranged
from mitransient_lidar.core.validation import integer
from mitransient_lidar.physics.lidar.gate_shape import GateShape
from mitransient_lidar.physics.lidar.gate_train import GatePlan, GateTrain
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plugins.bases import recorded
from mitransient_lidar.transport.histogram import TransientHistogram

_GATE_START = ("gate_start_ns", "gate_start_depth")
_GATE_SHAPE = ("gate_width_ns", "gate_rise_ns", "gate_fall_ns")


class TimeGatedFilm(mi.Film):
    r"""Time histogram of received energy of each pixel, and gates (``time_gated_film``).

    ================  =======  =========================================================================================
    Parameter         Type     Meaning
    ================  =======  =========================================================================================
    time_start_ns     float    Start of the first bin [ns] after the pulse's peak leaves the transmitter, up to
                               1e9 before or after. Default: 1390
    bin_width_ns      float    Width of a bin [ns], 1e-6 to 1e6. Default: 0.5
    bin_count         integer  Number of bins, 1 to 1 000 000. Default: 320
    gate_count        integer  Number of gates, 0 (none) to 100 000. Default: 0
    gate_start_ns     float    Half height of the first gate's rising edge [ns]
    gate_start_depth  float    Instead: depth of the echoes that arrive at that time [m], on the receiver's axis
    gate_width_ns     float    Time between the half heights of a gate's edges [ns], 1e-6 to 1e9. Default: 10
    gate_step_ns      float    Time from gate to gate [ns], 1e-6 to 1e9. Default: the width
    gate_rise_ns,     float    10-90 % times of raised-cosine edges [ns], 0 (sharp) to 1e9. Default: 0
    gate_fall_ns
    gate_profile      string   Instead of width and edges: file of two columns, time [ns] and transmission 0 to 1, or in
                               other units below a heading that names them
    pulses            integer  Number of pulses that each gate accumulates, 1 to 10^9. Default: 1
    ================  =======  =========================================================================================

    From a height H [m] at the angle theta off nadir, the echo of the sea arrives after 2 H/(0.2998 cos(theta)) ns; each
    metre of depth adds 9.1 ns at nadir and 9.4 ns at 20 degrees. The time start should be earlier by some pulse widths
    and by half the spread of the arrival over the field of view.

    Bins are half open, [start, start + width). After a render with a lidar integrator, ``develop`` returns the energy
    [J] of that pass as a tensor (pixel, time), or (row, column, time) for imagers. Energies are summed as integers, so
    that the same seed gives the same bits.

    ``mitransient_lidar.render`` cuts gates from the waveform, after pulse and response. Where the histogram of an
    imager exceeds the allowed memory, each arrival is added to the gates open during its pulse instead, and
    ``bin_width_ns`` and ``bin_count`` only set the end of the record.

    .. code-block:: xml

        <film type="time_gated_film">
            <float name="time_start_ns" value="1390"/>
            <float name="bin_width_ns" value="0.5"/>
            <integer name="bin_count" value="320"/>
        </film>

    .. code-block:: python

        {'type': 'time_gated_film', 'time_start_ns': 1390.0, 'bin_width_ns': 0.5, 'bin_count': 320}
    """

    def __init__(self, props: mi.Properties) -> None:
        #: Time bins of the record.
        self.axis = TimeAxis(
            ranged("time_start_ns", props.get("time_start_ns", 1390.0)),
            ranged("bin_width_ns", props.get("bin_width_ns", 0.5)),
            integer("bin_count", props.get("bin_count", 320), 1, 1_000_000),
        )
        #: Gates of the scene, or None.
        self.gates = _gate_plan(props)
        props["width"], props["height"] = self.axis.bin_count, 1
        super().__init__(props)
        self._pass: TransientHistogram | None = None

    def store(self, histogram: TransientHistogram) -> None:
        """Keep the histogram of the last pass, for `develop`, `bitmap` and `write`."""
        self._pass = histogram

    def energy(self) -> np.ndarray:
        """Return the energy [J] of the last pass as float64, shape (pixel, time) or (row, column, time).

        Bins are NaN where a value was not finite. Zeros of shape (1, time) before the first pass.
        """
        return np.zeros((1, self.axis.bin_count)) if self._pass is None else self._pass.energy()

    def develop(self, raw: bool = False) -> mi.TensorXf:
        """Return the energy [J] of the last pass, (pixel, time) or (row, column, time)."""
        return mi.TensorXf(self.energy().astype(np.float32))

    def clear(self) -> None:
        """Remove the last pass."""
        self._pass = None

    def bitmap(self, raw: bool = False) -> mi.Bitmap:
        """Return the last pass as a bitmap, time along x and pixels along y."""
        energy = self.energy()
        return mi.Bitmap(mi.TensorXf(energy.reshape(-1, energy.shape[-1], 1).astype(np.float32)))

    def write(self, path: str) -> None:
        """Write the bitmap of `bitmap` to an EXR file; ``mitransient_lidar.render`` writes the full stack."""
        self.bitmap().write(path)

    def prepare(self, aovs: list[str]) -> int:
        """Remove the last pass, for an integrator that is not a lidar integrator."""
        self.clear()
        return 1

    def base_channels_count(self) -> int:
        """Return 1: energy."""
        return 1

    def put_block(self, *args: object, **kwargs: object) -> mi.ImageBlock:
        """Raise UserError: image blocks have no time."""
        raise UserError("time_gated_film records time: use the integrator lidar_merging or lidar_volpath")

    create_block = put_block

    def schedule_storage(self) -> None:
        """Do nothing: passes are stored evaluated."""

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: a changed film is loaded again."""

    def to_string(self) -> str:
        """Return a description."""
        start, width, count = self.axis.start_ns, self.axis.bin_width_ns, self.axis.bin_count
        return f"TimeGatedFilm[time_start_ns={start:g}, bin_width_ns={width:g}, bin_count={count}]"


def _gate_plan(props: mi.Properties) -> GatePlan | None:
    """Read the gates of the film, or None; raise UserError where parameters contradict each other."""
    count = integer("gate_count", props.get("gate_count", 0), 0, 100_000)
    given = [name for name in (*_GATE_SHAPE, *_GATE_START, "gate_step_ns", "gate_profile", "pulses") if name in props]
    if count == 0:
        for name in given:
            props.mark_queried(name)
        return None
    starts = [name for name in _GATE_START if name in given]
    if len(starts) != 1:
        raise UserError(f"gate_count = {count} gates need either gate_start_ns or gate_start_depth")
    start = ranged(starts[0], props[starts[0]])
    pulses = integer("pulses", props.get("pulses", 1), 1, 10**9)
    if "gate_profile" in props:
        for name in _GATE_SHAPE:
            if name in given:
                raise UserError(f"{name} = {props[name]:g} and gate_profile: give one of them")
        profile = GateShape.from_file(str(props["gate_profile"]))
        step = ranged("gate_step_ns", props.get("gate_step_ns", profile.width_ns))
        train = GateTrain.measured(profile, 0.0, step, count, pulses)
    else:
        width = ranged("gate_width_ns", props.get("gate_width_ns", 10.0))
        rise, fall = (ranged(name, props.get(name, 0.0)) for name in _GATE_SHAPE[1:])
        step = ranged("gate_step_ns", props.get("gate_step_ns", width))
        train = GateTrain(0.0, width, step, count, rise, fall, pulses)
    return GatePlan(train, **{"start_ns" if starts[0] == "gate_start_ns" else "start_depth": start})


mi.register_film("time_gated_film", recorded(TimeGatedFilm))
