"""Film plugin ``time_gated_film``: the time axis of a record, and its gates."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import AUTO
from mitransient_lidar.core.parameters.lidar import TIME_GATED_FILM
from mitransient_lidar.physics.lidar.gate_train import GatePlan, GateShape, GateTrain
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plugins.bases import DeclaredProperties, closed, register
from mitransient_lidar.transport.paths.histogram import TransientHistogram

_GATE_START = ("gate_start_ns", "gate_start_depth", "gate_start_range")
_GATE_SHAPE = ("gate_width_ns", "gate_rise_ns", "gate_fall_ns")


@register("film", TIME_GATED_FILM)
@closed
class TimeGatedFilm(mi.Film):
    r"""Time histogram of each pixel's received energy, and gates (``time_gated_film``).

    .. parameters::

    With ``auto`` the record is chosen when a scene is rendered, anew after each edit. A result lists it as ``used`` in
    ``plugin_parameters``. It starts before the first light in any pixel, from the highest crest or a target above it.
    The lead is three pulse widths or a measured pulse's length, at least 12 ns. It also starts ten bins before the end
    of the interval in which ``echoes`` measures the noise, by up to 100 ns more. It ends as much, plus 12 times the
    response time, after the last light in any pixel. The last light comes from a bottom or target. Multiply scattered
    light gets up to 40 ns more, a quarter of the echo's time in the water, and the time from the beam to the edge of
    the view. Where no bottom is seen, or below 1e-12, the last light comes from the depth at which the column signal
    has fallen to 1e-6. The system attenuation of Gordon (1982) determines it: the beam attenuation coefficient in a
    narrow view, the diffuse one in a wide view. A film with gates contains these and all direct echoes.

    From a height H [m] at the angle theta off nadir, the sea echo arrives after 2 H/(0.2998 cos(theta)) ns. Each metre
    of depth adds 9.1 ns at nadir and 9.4 ns at 20 degrees.

    Bins are half open, [start, start + width). After a render with a lidar integrator, ``develop`` returns the energy
    [J] of that pass as a tensor (pixel, time), or (row, column, time) for imagers. Energies are summed as integers, so
    that the same seed gives the same bits.

    ``mitransient_lidar.render`` cuts gates from the waveform, after pulse and response. Where an imager's histogram
    exceeds the allowed memory, each arrival is added to the gates open during its pulse instead. In this case
    ``bin_width_ns`` and ``bin_count`` only set the end of the record.

    .. example::

        {'type': 'time_gated_film', 'bin_width_ns': 0.5}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        start, count = map(props.read, ("time_start_ns", "bin_count"))
        #: Record parameters; None for an automatic start [ns] or number of bins.
        self.time_start_ns = None if start == AUTO else start
        self.bin_width_ns = props.read("bin_width_ns")
        self.bin_count = None if count == AUTO else count
        #: Time bins that are given; None where an integrator chooses start or number for the scene.
        self.axis: TimeAxis | None = None
        if self.time_start_ns is not None and self.bin_count is not None:
            self.axis = TimeAxis(self.time_start_ns, self.bin_width_ns, self.bin_count)
        #: The scene's gates, or None.
        self.gates = _gate_plan(props)
        props["width"], props["height"] = self.bin_count or 1, 1
        super().__init__(props)
        self._pass: TransientHistogram | None = None

    def store(self, histogram: TransientHistogram) -> None:
        """Keep the histogram of the last pass, for `develop`, `bitmap` and `write`."""
        self._pass = histogram

    def energy(self) -> np.ndarray:
        """Return the energy [J] of the last pass as float64, shape (pixel, time) or (row, column, time).

        Bins are NaN where a value was not finite. Before the first pass: zeros with shape (1, time), or (1, 1) where
        the number of bins is automatic.
        """
        return np.zeros((1, self.bin_count or 1)) if self._pass is None else self._pass.energy()

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
        """Write the `bitmap` image to an EXR file; ``mitransient_lidar.render`` writes the full stack."""
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


def _gate_plan(props: DeclaredProperties) -> GatePlan | None:
    """Read the gates of the film, or None; raise UserError where parameters contradict each other."""
    read, count = props.read, props.read("gate_count")
    others = ("gate_step_ns", "gate_profile", "gate_jitter_ns", "pulses")
    given = [name for name in (*_GATE_SHAPE, *_GATE_START, *others) if name in props]
    if count == 0:
        for name in given:
            props.mark_queried(name)
        return None
    starts = [name for name in _GATE_START if name in given]
    if len(starts) != 1:
        raise UserError(f"gate_count = {count} gates need one of {', '.join(_GATE_START)}")
    start, pulses, jitter = map(read, (starts[0], "pulses", "gate_jitter_ns"))
    if "gate_profile" in props:
        shape = GateShape.from_file(str(props["gate_profile"]))
    else:
        shape = GateShape.edges(*map(read, _GATE_SHAPE))
    train = GateTrain.measured(shape.jittered(jitter), 0.0, read("gate_step_ns", shape.width_ns), count, pulses)
    return GatePlan(train, starts[0], start)
