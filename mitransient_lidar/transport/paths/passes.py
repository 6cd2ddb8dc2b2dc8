"""Independent passes over one scene, and their light: by scattering order and vertical reversals, or by origin."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.opaque import changed, opaque_index
from mitransient_lidar.transport.paths.histogram import GateWeights, TransientHistogram
from mitransient_lidar.transport.paths.ripple_focusing import Echo, RippleFocusing
from mitransient_lidar.transport.perturbations import Perturbation, Perturbations, Sums
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.rng import Shots
from mitransient_lidar.transport.scene import LidarScene

if TYPE_CHECKING:
    from mitransient_lidar.transport.paths.path import PathPoint

#: Label bits for the pixel, and for the number of scattering events; the others are for reversals.
_PIXEL_BITS, _ORDER_BITS = 20, 6

#: Label bits for the pixel where only scattering events are counted, and their largest number.
_MANY_PIXEL_BITS, _MOST_COUNTED = 28, 15

_MOST = (1 << _ORDER_BITS) - 1

MOST_ORDERS = _MOST - 1  #: Largest number of orders that can be separated.

#: Origins without a solid: light that has met the sea surface alone, and light that the water has scattered.
ORIGINS = ("surface", "water")

_MOST_SOLIDS = 30  #: Largest number of solids whose light can be separated: each takes as much memory as all light.


def check_solids(number: int) -> None:
    """Raise `UserError` if there are too many solids to separate their light."""
    if number > _MOST_SOLIDS:
        raise UserError(f"components: the scene has {number} solids; allowed are at most {_MOST_SOLIDS}")


@dataclass(frozen=True)
class PathClasses:
    """Classes into which each pixel's light is separated.

    Either scattering orders below `orders`, and all higher ones together; or the light's origin. This is the last one
    of the `solids` that the light has met, else the water if that has scattered it, else the surface. With `orders` = 0
    and without `solids` each pixel is one class. Labels have the number of scattering events, up to 15, if they are
    `counted`.
    """

    orders: int = 0
    solids: tuple[mi.Shape, ...] | None = None
    counted: bool = False

    @classmethod
    def by_origin(cls, solids: list[mi.Shape]) -> PathClasses:
        """Return the classes of light by origin; raise UserError for too many solids."""
        check_solids(len(solids))
        return cls(solids=tuple(solids))

    @property
    def by_order(self) -> bool:
        """Whether there are classes by scattering order."""
        return self.orders > 0

    @property
    def labels_orders(self) -> bool:
        """Whether labels have the numbers of scattering events."""
        return self.by_order or self.counted

    @property
    def separate(self) -> bool:
        """Whether there are several classes."""
        return self.by_order or self.solids is not None

    @property
    def names(self) -> list[str]:
        """Origin names."""
        return [*ORIGINS, *(str(solid.id()) for solid in self.solids or ())]

    @property
    def count(self) -> int:
        """Classes per pixel: origins; or orders, for one reversal and then for several."""
        if self.by_order:
            return 2 * (self.orders + 1)
        return 1 if self.solids is None else len(ORIGINS) + len(self.solids)

    def pack(self, point: PathPoint) -> mi.UInt32:
        """Return point labels: their pixels, with their numbers of scattering events and reversals."""
        if not self.labels_orders:
            return point.pixel
        if not self.by_order:
            return point.pixel | (dr.minimum(point.scatterings, _MOST_COUNTED) << _MANY_PIXEL_BITS)
        events, reversals = (dr.minimum(each, _MOST) for each in (point.scatterings, point.reversals))
        return point.pixel | (events << _PIXEL_BITS) | (reversals << (_PIXEL_BITS + _ORDER_BITS))

    def unpack(self, label: mi.UInt32) -> dict[str, mi.UInt32]:
        """Return ``pixel``, ``scatterings`` and ``reversals`` of a label, where they are counted."""
        if not self.labels_orders:
            return {"pixel": label}
        if not self.by_order:
            return {"pixel": label & ((1 << _MANY_PIXEL_BITS) - 1), "scatterings": label >> _MANY_PIXEL_BITS}
        events, reversals = label >> _PIXEL_BITS, label >> (_PIXEL_BITS + _ORDER_BITS)
        return {"pixel": label & ((1 << _PIXEL_BITS) - 1), "scatterings": events & _MOST, "reversals": reversals}

    def solid(self, shape: mi.ShapePtr) -> mi.UInt32:
        """Return the numbers of solids among those that are separated, from 1 on; 0 for other shapes."""
        number = mi.UInt32(0)
        for index, solid in enumerate(self.solids or (), 1):
            number = dr.select(shape == mi.ShapePtr(solid), mi.UInt32(index), number)
        return number

    def index(self, pixel: mi.UInt32, order: mi.UInt32, reversals: mi.UInt32, solid: mi.UInt32) -> mi.UInt32:
        """Return the index of a pixel's class; `solid` is the number of the last solid that the light has met."""
        if self.solids is not None:
            scattered = dr.select(order > 0, mi.UInt32(1), 0)
            return pixel * self.count + dr.select(solid > 0, solid + (len(ORIGINS) - 1), scattered)
        if not self.by_order:
            return pixel
        several = dr.select(reversals > 1, mi.UInt32(self.orders + 1), 0)
        return pixel * self.count + several + dr.minimum(order, self.orders)


class ReceivedLight:
    """Light received in one pass: a histogram by pixel, or by pixel class, and time."""

    def __init__(
        self,
        histograms: Sequence[TransientHistogram],
        classes: PathClasses,
        focusing: RippleFocusing | None = None,
        tile: range | None = None,
    ) -> None:
        self._all, self.classes, self.focusing = histograms, classes, focusing
        #: Pixels that are received alone, or None.
        self.tile = tile
        self._limits = None if tile is None else (opaque_index(tile.start), opaque_index(len(tile)))
        #: The histogram, and that of gates beside it, or None.
        self.histogram, self.gated = histograms[0], histograms[1] if len(histograms) > 1 else None
        self.clear()

    def clear(self) -> None:
        """Remove all light."""
        for each in self._all:
            each.clear()
        self.rays = mi.Float64(0)  #: Number of traced rays.

    def receive(
        self,
        pixel: mi.UInt32,
        order: mi.UInt32,
        reversals: mi.UInt32,
        solid: mi.UInt32,
        length: mi.Float,
        energy: mi.Float,
        active: mi.Bool,
        echo: Echo | None = None,
        sums: Sums | None = None,
    ) -> None:
        """Add paths' energy [J] by relative optical length [m] and by their class variables.

        These are the scattering order, the number of reversals, and the last met solid's number, from 1 on, or 0
        (`PathClasses`). Ripples enhance an `echo` from under water. `sums` are the perturbation sums of the scene.
        """
        if self.focusing is not None and echo is not None:
            factor = self.focusing.of(echo, order, length)
            energy = energy * factor
            sums = self.focusing.perturb(sums or [], factor, echo, order, length)
        if self._limits is not None:
            pixel = pixel - self._limits[0]
            active = active & (pixel < self._limits[1])
        index = self.classes.index(pixel, order, reversals, solid)
        for each in self._all:
            each.add(index, length, energy, active, sums)

    @property
    def edge_loss(self) -> float:
        """Energy that would have been received if the surface mesh did not end [J]."""
        return self.histogram.lost

    def evaluate(self) -> None:
        """Compute the energies."""
        for each in self._all:
            each.evaluate()
        dr.eval(self.rays)


class PassRenderer(ABC):
    """Renders independent passes of one prepared scene, by default with `paths` paths from the receiver each.

    A pass may hold several shots, which have these paths each, and pixels of their own.
    """

    def __init__(
        self,
        scene: LidarScene,
        classes: PathClasses,
        paths: int,
        cells: Callable[[FloatArray], FloatArray] | None = None,
        probe: Probe | None = None,
    ) -> None:
        self.scene, self.paths = scene, paths
        #: Enhancement by ripples, or None; `cells` as of `RippleFocusing.of_scene`.
        self.focusing = RippleFocusing.of_scene(scene, cells)
        self.classes = replace(classes, counted=self.focusing is not None)
        self.probe = probe or Probe(scene)
        self.sampler = self.probe.sampler

    @property
    def path_count(self) -> int:
        """Number of paths in a pass from either end."""
        return self.paths

    @property
    def memory(self) -> tuple[float, float]:
        """Memory of a pass's paths, for all pixels together and for each received pixel [bytes]."""
        return 0.0, 0.0

    @property
    def used_values(self) -> dict[str, float]:
        """Values used for parameters of the integrator that may be automatic."""
        return {"paths_per_pass": self.paths}

    def scaled(self, share: float) -> PassRenderer:
        """Return a renderer for passes with a share of the paths."""
        return changed(self, paths=max(round(share * self.paths), 1))

    def for_smoothing(self, share: float) -> PassRenderer:
        """Return a renderer for images that are smoothed over pixels, with a share of the receiver's paths."""
        return self.scaled(share)

    def for_differences(self) -> PassRenderer:
        """Return a renderer on which differences of scenes have less noise, by default this one."""
        return self

    def by_origin(self) -> PassRenderer:
        """Return a renderer that separates light by its origin; raise UserError for too many solids."""
        classes = PathClasses.by_origin(self.scene.solids)
        return changed(self, classes=replace(classes, counted=self.classes.counted))

    def perturbed(self, perturbations: Sequence[Perturbation]) -> PassRenderer:
        """Return a renderer whose light has perturbations, too."""
        scene = replace(self.scene, perturbations=Perturbations(perturbations))
        focusing = None if self.focusing is None else self.focusing.perturbed(perturbations)
        return changed(self, scene=scene, focusing=focusing)

    def of_shots(self, scene: LidarScene, shots: int) -> PassRenderer:
        """Return a renderer for a number of shots that meet a scene in parts."""
        return changed(self, scene=scene)

    def repeated(self, scene: LidarScene, copies: int) -> PassRenderer:
        """Return a renderer of each shot several times in turn, which meet a scene in parts."""
        return changed(self, scene=scene)

    def render_pass(
        self,
        seed: int | Sequence[int],
        *,
        paths: int | None = None,
        gates: GateWeights | None = None,
        beside: bool = False,
        tile: range | None = None,
    ) -> ReceivedLight:
        """Render one pass, for one shot or, with several seeds, for several.

        Passes with different seeds are independent. Energy is summed over `gates` instead of time bins if they are
        given, or `beside` them. The pixels of several shots are one row, shot after shot. Of one shot, the pixels of a
        `tile` may be received alone: they have the same bits, in less memory.

        Raises UserError when the histogram would be too large.
        """
        pixels, shots = self.scene.receiver.pixels, Shots(seed if isinstance(seed, Sequence) else [seed])
        flat = (shots.count * (pixels.count if tile is None else len(tile)) * self.classes.count,)
        shape = flat if self.classes.separate or shots.count > 1 or tile else pixels.grid or flat
        scene = self.scene
        emitted, length = scene.transmitter.energy, scene.reference_length
        kinds = (None, gates) if beside else (gates,)
        sums = [TransientHistogram(scene.axis, shape, emitted, kind, length, scene.perturbations) for kind in kinds]
        received = ReceivedLight(sums, self.classes, self.focusing, tile)
        with dr.suspend_grad():
            self.trace(received, shots, self.paths if paths is None else paths)
        received.evaluate()
        return received

    @abstractmethod
    def trace(self, received: ReceivedLight, shots: Shots, paths: int) -> None:
        """Trace a number of paths in one pass for each shot, and add their light."""


@runtime_checkable
class LidarIntegrator(Protocol):
    """The integrators ``lidar_merging`` and ``lidar_volpath``."""

    plugin: str
    passive: bool
    prepare: Callable[..., PassRenderer]  #: Returns the pass renderer for a scene, as `LidarPassIntegrator.prepare`.
