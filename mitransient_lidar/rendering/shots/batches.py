"""One lidar's shots at several places, and in several poses, rendered together in batches."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import raise_if_out_of_memory
from mitransient_lidar.core.validation import BoolArray, FloatArray, IntArray, require_memory
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.plugins.ocean_surface import SeaPatches
from mitransient_lidar.rendering.accumulators import Light
from mitransient_lidar.rendering.accuracy import ErrorWindow
from mitransient_lidar.rendering.passes import SMALLEST_SHARE, pass_seed
from mitransient_lidar.transport.light_maps import suitability
from mitransient_lidar.transport.light_maps.maps import HeightFields
from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
from mitransient_lidar.transport.light_maps.suitability import REACH_THE_SURFACE
from mitransient_lidar.transport.medium.bubbles import BubblePlume
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.opaque import aligned
from mitransient_lidar.transport.paths.passes import PassRenderer
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.probe import land_of_shots
from mitransient_lidar.transport.scene import LidarScene, ScenePart
from mitransient_lidar.transport.solids import scene_of_shapes

_PATHS, _BINS = 2**17, 2**24  #: Paths of all shots in a launch, and time bins of all their pixels.
_MOST_SHOTS = 64  #: Largest number of shots in a batch: their sea has 120 000 triangles a shot.

#: Memory per bin in a series, for mean and standard error of energy and power, and their copy in the result [bytes].
_BYTES_PER_BIN = 64

#: Fewest and most passes that are repeated until an error is reached.
_PASSES_FOR_ERROR, MOST_PASSES_FOR_ERROR = 4, 400

#: Path share with which the fewest passes reach an error in the published geometry under 6 m/s waves, and that error. A
#: pass error falls with its number of paths to this exponent.
_KNOWN_SHARE, _KNOWN_ERROR, _ERROR_EXPONENT = 0.05, 0.05, 0.65


@dataclass(frozen=True)
class ShotPoses:
    """Shot locations, and poses that differ from the lidar's.

    A shot's frame is turned about the vertical, so that its receiver differs least from the lidar's. It is also
    displaced, so that the receiver's axis meets the mean sea level at the same point as the lidar's.
    """

    #: Points (x, y) in the scene where the receiver's axes meet the mean sea level [m], shape (shots, 2).
    places: FloatArray
    #: Cosine and sine of the rotations about the vertical, shape (shots, 2); None without any difference.
    turns: FloatArray | None = None
    #: Poses in each shot's frame; None where all are the lidar's.
    receiver: KernelPose | None = None
    transmitter: KernelPose | None = None
    in_scene: Pose | None = None  #: Receiver poses in the scene; None where they follow from the locations.
    #: Times at which shots meet the waves [s], shape (shots,); None for the scene's time.
    times_s: FloatArray | None = None
    #: Heights by which shots meet the solids raised [m], shape (shots,), over light maps; None for no height.
    raised: FloatArray | None = None
    #: Places of the sea that shots meet instead of the waves at their own [m], and their turns there, as `turns`, both
    #: of shape (shots, 2); None for their own.
    other_sea: tuple[FloatArray, FloatArray] | None = None

    @classmethod
    def of_receiver(cls, lidar: LidarScene, receiver: Pose) -> ShotPoses:
        """Return a lidar's shot poses from the receiver's poses in the scene, arrays with the shape (shots, 3).

        The transmitter is fixed to the receiver. All axes must go down.
        """
        own = lidar.receiver.pose
        places = receiver.ground_point()
        # The rotation from the lidar to each shot, and that about the vertical which is nearest to it.
        whole = np.swapaxes(receiver.frame, 1, 2) @ own.frame
        azimuth = whole[:, 0, 0] + whole[:, 1, 1] + 1j * (whole[:, 1, 0] - whole[:, 0, 1])
        turns = azimuth / np.abs(azimuth)
        to_frame = _rotations(np.conj(turns))
        centre = own.ground_point()
        origin = np.squeeze(to_frame @ (receiver.origin - places)[..., None], -1) + centre
        rotation = to_frame @ whole
        shift = origin - rotation @ own.origin
        own_receiver, own_transmitter = (pose.moved(rotation, shift) for pose in (own, lidar.transmitter.pose))
        cos_sin = np.stack([turns.real, turns.imag], axis=-1)
        return cls(places[:, :2], cos_sin, own_receiver, own_transmitter, receiver)

    def __len__(self) -> int:
        return len(self.places)

    def part(self, rows: slice | IntArray) -> ShotPoses:
        """Return some shots."""
        turns = None if self.turns is None else self.turns[rows]
        receiver = None if self.receiver is None else self.receiver.part(rows)
        transmitter = None if self.transmitter is None else self.transmitter.part(rows)
        in_scene = None if self.in_scene is None else self.in_scene.part(rows)
        times_s = None if self.times_s is None else self.times_s[rows]
        raised = None if self.raised is None else self.raised[rows]
        other_sea = None if self.other_sea is None else (self.other_sea[0][rows], self.other_sea[1][rows])
        return ShotPoses(self.places[rows], turns, receiver, transmitter, in_scene, times_s, raised, other_sea)

    @property
    def on_sea(self) -> ShotPoses:
        """The shots as they meet the sea."""
        return self if self.other_sea is None else replace(self, places=self.other_sea[0], turns=self.other_sea[1])

    def repeated(self, copies: int) -> ShotPoses:
        """Return each shot several times in turn."""
        return self.part(np.repeat(np.arange(len(self)), copies))

    def delayed(self, lengths: FloatArray) -> ShotPoses:
        """Return the shots with a length added to their optical paths [m], shape (shots,)."""
        return replace(self, receiver=None if self.receiver is None else replace(self.receiver, delay=lengths))

    def scene_part(self, shapes: mi.Scene, positions: FloatArray | None, aim: FloatArray) -> ScenePart:
        """Return shapes as the shots meet them.

        `shapes`: the shapes. `positions`: points (x, y) among them of the shots' places [m], shape (shots, 2); None for
        shapes that go with the lidar. `aim`: the lidar's place (x, y) in its frame [m], shape (2,).
        """
        if positions is None:
            positions = np.broadcast_to(aim, (len(self), 2))
        if self.turns is None:
            return ScenePart(shapes, _vectors(positions - aim, self.raised))
        turned = (self.turns[:, 0] + 1j * self.turns[:, 1]) * complex(*aim)
        by = positions - np.stack([turned.real, turned.imag], axis=-1)
        cos, sin = (aligned(mi.Float, column.astype(np.float32)) for column in self.turns.T)
        return ScenePart(shapes, _vectors(by), mi.Vector2f(cos, sin))

    def water(self, water: Water | None, place: FloatArray, aim: FloatArray) -> Water | None:
        """Return a lidar's water at `aim` as a shot at a place meets it, both x, y in the lidar's frame [m]."""
        if water is None or not isinstance(water.plume, BubblePlume):
            return water
        turn = 1 + 0j if self.turns is None else complex(*self.turns[0])
        return replace(water, plume=water.plume.displaced(place, aim, turn))

    def extra_range(self, lidar: LidarScene) -> FloatArray:
        """Return the length from laser to receiver by the shared reference point beyond the lidar's own [m], (shots,).

        Arrival times are relative to it: a shot's times begin later by this length over the speed of light.
        """
        if self.receiver is None or self.transmitter is None:
            return np.zeros(len(self))
        reference = lidar.receiver.pose.nearby_point()
        ranges = [np.linalg.norm(pose.origin - reference, axis=1) for pose in (self.receiver, self.transmitter)]
        return np.asarray(ranges[0] + ranges[1] - lidar.reference_length)


def _rotations(turns: npt.NDArray[np.complex128]) -> FloatArray:
    """Return rotations about the vertical by azimuths, shape (shots, 3, 3)."""
    found = np.zeros((len(turns), 3, 3))
    found[:, 0, 0] = found[:, 1, 1] = turns.real
    found[:, 1, 0], found[:, 0, 1] = turns.imag, -turns.imag
    found[:, 2, 2] = 1.0
    return found


def _vectors(horizontal: FloatArray, down: FloatArray | None = None) -> mi.Vector3f:
    """Return vectors with horizontal components, shape (n, 2), and a component down, shape (n,), by default 0."""
    rows = *horizontal.T, np.zeros(len(horizontal)) if down is None else -down
    return mi.Vector3f(*(aligned(mi.Float, row.astype(np.float32)) for row in rows))


@dataclass(frozen=True)
class ReceivedShots:
    """Means over shots' passes, and their standard errors."""

    #: Mean energy [J per bin], its standard error, mean power after the pulse and the receiver's response [W], and its
    #: standard error, shape (shots, pixels, bins).
    whole: tuple[FloatArray, ...]
    lost: float  #: Energy lost at the surface mesh's edges [J], mean over the passes of all shots.
    passes: IntArray  #: Passes per shot, shape (shots,).
    #: The same four arrays of light by origin, (shots, pixels, origins, bins); none unless the renderer separates it.
    parts: tuple[FloatArray, ...] = ()
    #: The same four arrays for derivatives, shape (shots, parameters, pixels, bins); none unless the renderer has
    #: perturbations.
    derivatives: tuple[FloatArray, ...] = ()
    missed: int = 0  #: Number of shots whose passes ended before the requested error.
    #: Relative standard errors of the bins that count (`ErrorWindow`), one row.
    errors: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def joined(cls, several: Sequence[ReceivedShots], order: IntArray | None = None) -> ReceivedShots:
        """Return all shots' light from several batches, in an order."""
        if order is not None:
            several = [cls.joined(several)._in_order(order)]
        whole, parts, derivatives = (
            tuple(np.concatenate(arrays) for arrays in zip(*(getattr(one, name) for one in several), strict=True))
            for name in ("whole", "parts", "derivatives")
        )
        passes, errors = (np.concatenate([getattr(one, name) for one in several]) for name in ("passes", "errors"))
        lost, missed = (sum(getattr(one, name) for one in several) for name in ("lost", "missed"))
        return cls(whole, lost, passes, parts, derivatives, missed, errors)

    def _in_order(self, order: IntArray) -> ReceivedShots:
        """Return the shots in another order."""
        some = (self.whole, self.parts, self.derivatives)
        whole, parts, changes = (tuple(each[order] for each in arrays) for arrays in some)
        return ReceivedShots(whole, self.lost, self.passes[order], parts, changes, self.missed, self.errors)


class ShotBatches:
    """A renderer's scene, displaced to shot batches' locations.

    The lidar's frame is the scene's frame, and a shot's location is its aim. The sea is refined about each location,
    and the patches lie beside each other in one mesh. Solids are met at the location itself, except solids that move
    with the lidar. A bubble plume belongs to one shot: such scenes have a batch for each.

    `renderer`: renderer for the shot at the scene's location. `aim`: location (x, y) in the scene of its own shot [m].
    `passes`: passes for each shot, the most with a `goal`. `share`: share of a full pass's paths. `goal`: relative
    standard error of a batch's median bin that ends its passes. `window`: bins that count, for a shot without land;
    None where none do. `companions`: solids that move with the lidar.
    """

    def __init__(
        self,
        renderer: PassRenderer,
        aim: tuple[float, float],
        passes: int,
        share: float,
        goal: float | None,
        window: ErrorWindow | None,
        companions: Sequence[mi.Shape],
    ) -> None:
        lidar = renderer.scene
        has_plume = lidar.water is not None and isinstance(lidar.water.plume, BubblePlume)
        self._renderer, self.passes, self.share = renderer.scaled(share), passes, share
        self._frame_origin = lidar.frame_origin[:2]
        self._aim = np.array(aim) - self._frame_origin
        self._goal, self._window, in_turn = goal, window, passes if goal is None else _PASSES_FOR_ERROR
        self._seconds = math.inf
        with_maps = isinstance(renderer, LightMapRenderer)
        waves = [sea for sea in lidar.seas if with_maps or np.isfinite(sea.sea.cell_size)]
        level = [sea for sea in lidar.seas if not with_maps and np.isinf(sea.sea.cell_size)]
        going = [*level, *companions]
        fixed = [shape for shape in lidar.mitsuba_scene.shapes() if not any(shape is one for one in [*waves, *going])]
        self._seas = [SeaPatches(shape) for shape in waves]
        self._known: dict[tuple[float, ...], tuple[FloatArray, FloatArray]] = {}
        self._going, self._fixed = (
            scene_of_shapes(shapes, lidar.groups) if shapes else None for shapes in (going, fixed)
        )
        paths = max(self._renderer.path_count // 2, 1)
        self._origins, self._perturbations = renderer.classes.count, lidar.perturbations.count
        bins = lidar.receiver.pixels.count * lidar.axis.bin_count * self._origins * (1 + self._perturbations)
        #: Shots in a batch.
        self.size = 1 if has_plume else int(np.clip(_PATHS // (paths * in_turn), 1, _MOST_SHOTS))
        #: Passes of a batch in one launch.
        most = min(_PATHS // (paths * self.size), _BINS // (bins * self.size))
        self._together = 1 if has_plume else int(np.clip(most, 1, in_turn))

    def at(self, shots: ShotPoses) -> Callable[[int], PassRenderer]:
        """Return a function that returns the renderer for shots, each several times."""
        if isinstance(self._renderer, LightMapRenderer):
            return self._over_maps(self._renderer, shots)
        parts: list[tuple[mi.Scene, FloatArray | None, bool]] = []
        parts += [] if self._going is None else [(self._going, None, False)]
        for sea in self._seas:
            positions = sea.move(shots.on_sea.places, shots.times_s)
            parts.append((sea.shapes, positions, True))
        places = shots.places - self._frame_origin
        parts += [] if self._fixed is None else [(self._fixed, places, False)]
        lidar = self._renderer.scene
        water = shots.water(lidar.water, places[0], self._aim)
        surfaces = [*lidar.surfaces, *(sea.shape for sea in self._seas)]

        def scene_of(copies: int) -> LidarScene:
            all_shots = shots.repeated(copies)
            moved = tuple(
                (all_shots.on_sea if is_sea else all_shots).scene_part(
                    shapes, None if positions is None else np.repeat(positions, copies, axis=0), self._aim
                )
                for shapes, positions, is_sea in parts
            )
            receiver, transmitter = all_shots.receiver, all_shots.transmitter
            placed = replace(lidar, parts=moved, surfaces=surfaces, water=water)
            return replace(placed, receiver_poses=receiver, transmitter_poses=transmitter)

        placed = self._renderer.of_shots(scene_of(1), len(shots))
        return lambda copies: placed.repeated(scene_of(copies), copies)

    def _over_maps(self, renderer: LightMapRenderer, shots: ShotPoses) -> Callable[[int], PassRenderer]:
        """Return as `at` a renderer by light maps, which has sea heights instead of a mesh."""
        lidar, sea = renderer.scene, self._seas[0]
        heights, corners = self._heights(sea, shots)
        values = aligned(mi.Float, heights)
        places = shots.places - self._frame_origin
        parts = [(scene, at) for scene, at in ((self._going, None), (self._fixed, places)) if scene is not None]

        def renderer_of(copies: int) -> PassRenderer:
            all_shots = shots.repeated(copies)
            moved = [
                all_shots.scene_part(scene, None if at is None else np.repeat(at, copies, axis=0), self._aim)
                for scene, at in parts
            ]
            on_sea = all_shots.on_sea
            waves = on_sea.scene_part(lidar.mitsuba_scene, on_sea.places, self._aim)
            placed = replace(
                lidar, parts=tuple(moved), receiver_poses=all_shots.receiver, transmitter_poses=all_shots.transmitter
            )
            fields = HeightFields.of_patches(values, corners, sea.cell_size, sea.wind_direction, waves, copies)
            return renderer.over(placed, fields)

        return renderer_of

    def _heights(self, sea: SeaPatches, shots: ShotPoses) -> tuple[FloatArray, FloatArray]:
        """Return the sea's heights about shots, as `SeaPatches.heights` has them, once where only solids differ."""
        if shots.raised is None:
            whole: tuple[FloatArray, FloatArray] = sea.heights(shots.on_sea.places, shots.times_s)
            return whole
        wanted = [tuple(place) for place in shots.on_sea.places.tolist()]
        for place in {*wanted} - self._known.keys():
            self._known[place] = sea.heights(np.array([place]))
        heights, corners = zip(*(self._known[place] for place in wanted), strict=True)
        return np.concatenate(heights), np.concatenate(corners)

    def limited(self, passes: int, seconds: float) -> ShotBatches:
        """Return the same batches with fewer passes, at least 2, and a time after which no launch may end [s].

        The shots in a launch stay the same, so that a batch ended by time has the same bits again with its pass number.
        Two passes are rendered in any time.
        """
        other = copy.copy(self)
        other.passes, other._seconds = passes, seconds
        return other

    def render(self, poses: ShotPoses, seeds: Sequence[int]) -> ReceivedShots:
        """Render a batch's shots, each with its own seed."""
        shots, done, copies, lost, needed = len(poses), 0, 0, 0.0, self._together
        ends = [time.perf_counter()]
        light = Light(self._renderer.scene, self._origins > 1)
        try:
            several = self.at(poses)
            window = self._window_of(several, shots)
            while done < self.passes and needed > 0:
                if (here := min(self._together, self.passes - done, needed)) != copies:
                    renderer, copies = several(here), here
                numbers = [pass_seed(seed, done + number) for seed in seeds for number in range(here)]
                received = renderer.render_pass(numbers)
                lost += received.edge_loss
                shape = shots, here, -1, self._origins, renderer.scene.axis.bin_count
                found, changes = received.histogram.energy().reshape(shape), None
                if self._perturbations:
                    changes = np.moveaxis(received.histogram.perturbed().reshape(self._perturbations, *shape), 0, 2)
                for number in range(here):
                    light.add(found[:, number], None if changes is None else changes[:, number])
                done += here
                ends.append(time.perf_counter())
                if self._goal is not None and done >= _PASSES_FOR_ERROR:
                    error = float(np.median(_errors(window, light)))
                    rest = min((error / self._goal) ** 2 - 1, 1e3)
                    needed = 0 if error <= self._goal else math.ceil(done * rest)
                if done >= 2 and 2 * ends[-1] - ends[-2] - ends[0] > self._seconds:
                    break
        except (RuntimeError, MemoryError) as error:
            raise_if_out_of_memory(error)
            raise
        missed, passes = shots if self._goal is not None and needed > 0 else 0, np.full(shots, done)
        errors = _errors(window, light)
        return ReceivedShots(
            light.arrays, lost / done, passes, light.parts.arrays, light.perturbed.arrays, missed, errors
        )

    def _window_of(self, several: Callable[[int], PassRenderer], shots: int) -> ErrorWindow | None:
        """Return the bins that count in each shot, which may see land."""
        lidar = self._renderer.scene
        highest, lowest = lidar.empty_heights
        if self._window is None or highest <= lowest or lidar.submerged:
            return self._window
        return self._window.with_land(lidar, *land_of_shots(several(1).scene, shots))

    def parts(self, count: int) -> Iterator[slice]:
        """Return the shots in each batch of `count`."""
        for first in range(0, count, self.size):
            yield slice(first, min(first + self.size, count))

    @property
    def used_values(self) -> dict[str, float]:
        """Values used for integrator parameters that may be automatic."""
        return self._renderer.used_values


def _errors(window: ErrorWindow | None, light: Light) -> FloatArray:
    """Return the counted bins' relative standard errors, none before the second pass."""
    power = light.whole.power
    return np.zeros(0) if window is None or power.count < 2 else window.relative_errors(power.mean, power.stderr)


def suits_maps(lidar: LidarScene, poses: ShotPoses) -> BoolArray:
    """Return which shots in a scene that suits light maps serve: over water, with faint light on targets."""
    places = poses.places - lidar.frame_origin[:2]
    faint = [suitability.light_faintly(lidar, target, places, poses.turns) for target in lidar.targets]
    return np.asarray(np.all([suitability.over_water(lidar, places, poses.turns), *faint], axis=0))


def require_water(lidar: LidarScene, poses: ShotPoses) -> None:
    """Raise `UnsuitedError` if light maps do not suit shots, since they meet land, or solids near the surface."""
    dry = ~suitability.over_water(lidar, poses.places - lidar.frame_origin[:2], poses.turns)
    if dry.any():
        raise suitability.UnsuitedError(f"{REACH_THE_SURFACE} in {np.count_nonzero(dry)} shots")


def share_for_error(error: float) -> float:
    """Return the path share for passes that are repeated until a relative error is reached."""
    return float(np.clip(_KNOWN_SHARE * (_KNOWN_ERROR / error) ** (1 / _ERROR_EXPONENT), SMALLEST_SHARE, 1.0))


def check_size(shots: int, pixels: int, bins: int, origins: int = 0, parameters: int = 0) -> None:
    """Refuse series that do not fit the memory, with light by `origins` and derivatives beside the whole."""
    components = f", and {origins} components of each," if origins else ""
    components += f", and {parameters} derivatives of each," if parameters else ""
    size = _BYTES_PER_BIN * shots * pixels * bins * (1 + origins + parameters)
    what = f"{shots} shots of {pixels} pixels x {bins} bins{components}"
    require_memory(what, size, "take fewer shots, or reduce the pixels or bin_count")
