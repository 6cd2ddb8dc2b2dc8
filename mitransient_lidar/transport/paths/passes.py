"""Independent passes over one scene, and the light that they receive."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.opaque import changed
from mitransient_lidar.transport.paths.histogram import GateWeights, TransientHistogram
from mitransient_lidar.transport.paths.path_classes import PathClasses
from mitransient_lidar.transport.paths.ripple_focusing import Echo, RippleFocusing
from mitransient_lidar.transport.perturbations import Perturbation, Perturbations, Sums
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.rng import Shots
from mitransient_lidar.transport.scene import LidarScene


class ReceivedLight:
    """Light received in one pass: a histogram by pixel, or by pixel class, and time.

    Attributes
    ----------
    rays
        Number of traced rays.
    gated
        Light in gates that is received beside the histogram, or None.
    """

    def __init__(
        self, histograms: Sequence[TransientHistogram], classes: PathClasses, focusing: RippleFocusing | None = None
    ) -> None:
        self._all, self.classes, self.focusing = histograms, classes, focusing
        self.histogram, self.gated = histograms[0], histograms[1] if len(histograms) > 1 else None
        self.clear()

    def clear(self) -> None:
        """Remove all light."""
        for each in self._all:
            each.clear()
        self.rays = mi.Float64(0)

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
        """Add the energy [J] of paths by relative optical length [m] and by the variables of their class.

        These are the scattering order, the number of reversals, and the number of the last solid that the light has
        met, from 1 on, or 0 (`PathClasses`). Ripples enhance an `echo` from under water. `sums` are the perturbation
        sums of the scene.
        """
        if self.focusing is not None and echo is not None:
            factor = self.focusing.of(echo, order, length)
            energy = energy * factor
            sums = self.focusing.perturb(sums or [], factor, echo, order, length)
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
    ) -> None:
        self.scene, self.paths = scene, paths
        #: Enhancement by ripples, or None; `cells` as of `RippleFocusing.of_scene`.
        self.focusing = RippleFocusing.of_scene(scene, cells)
        self.classes = replace(classes, counted=self.focusing is not None)
        self.probe = Probe(scene)
        self.sampler = self.probe.sampler

    @property
    def path_count(self) -> int:
        """Number of paths in a pass from either end."""
        return self.paths

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
    ) -> ReceivedLight:
        """Render one pass, for one shot or, with several seeds, for several.

        Passes with different seeds are independent. Energy is summed over `gates` instead of time bins if they are
        given, or `beside` them. The pixels of several shots are one row, shot after shot.

        Raises UserError when the histogram would be too large.
        """
        pixels, shots = self.scene.receiver.pixels, Shots(seed if isinstance(seed, Sequence) else [seed])
        flat = (shots.count * pixels.count * self.classes.count,)
        shape = flat if self.classes.separate or shots.count > 1 else pixels.grid or flat
        scene = self.scene
        emitted, length = scene.transmitter.energy, scene.reference_length
        kinds = (None, gates) if beside else (gates,)
        sums = [TransientHistogram(scene.axis, shape, emitted, kind, length, scene.perturbations) for kind in kinds]
        received = ReceivedLight(sums, self.classes, self.focusing)
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
    #: Returns the pass renderer for a scene, as `LidarPassIntegrator.prepare`.
    prepare: Callable[..., PassRenderer]
