"""Integrator plugins ``lidar_merging``, ``lidar_volpath`` and ``passive_volpath``."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.integrators import LIDAR_MERGING, LIDAR_VOLPATH, PASSIVE_VOLPATH
from mitransient_lidar.core.validation import integer
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plugins.bases import DeclaredProperties, register
from mitransient_lidar.transport.daylight.renderer import DaylightRenderer, DaylightScene, ReceivedDaylight
from mitransient_lidar.transport.merging.layout import MergingOptions
from mitransient_lidar.transport.merging.renderer import MergingRenderer, paths_of_pass
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses
from mitransient_lidar.transport.paths.volpath import VolpathOptions, VolpathRenderer
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import find_lidar_scene
from mitransient_lidar.transport.sensor.receiver import Receiver


class PassIntegrator(mi.CppADIntegrator):
    """Integrator that prepares a scene and renders one pass of it.

    It keeps no scene state: every ``mi.render`` call prepares the scene again, with changes by ``mi.traverse``.
    ``mitransient_lidar.render`` prepares a scene once for all passes.
    """

    plugin: str  #: Integrator name in results.

    #: Whether it renders daylight instead of lidar echoes.
    passive = False

    @abstractmethod
    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> Any:
        """Return the pass renderer for a scene (`PassRenderer` or `DaylightRenderer`).

        Raises UserError when the scene lacks a part or has one that the integrator does not support.
        """

    def develop(self, received: Any, sensor: mi.Sensor) -> mi.TensorXf:
        """Return the energy [J] of a pass, and store it in the sensor's film."""
        sensor.film().store(received.histogram)
        return sensor.film().develop()

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render one pass; passes with different seeds are independent.

        `spp` is the number of paths per pixel; 0 selects the integrator's total number of paths. Without `develop` the
        result is empty; `evaluate` is not used.

        Returns
        -------
        TensorXf
            Received energy [J], shape (pixel, time) or (row, column, time); by daylight radiance [W m^-2 sr^-1 nm^-1],
            shape (pixel,) or (row, column), 0 where no path started.

        Raises
        ------
        UserError
            When `prepare` raises it, or `seed` is not within 0 to 2^64 - 1, or `spp` not within 0 to 2^28.
        """
        seed, spp = integer("seed", int(np.array(seed).item()), 0, 2**64 - 1), integer("spp", spp, 0, 2**28)
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        renderer = self.prepare(scene, sensor)
        paths = spp * renderer.scene.receiver.pixels.count if spp > 0 else None
        result = self.develop(renderer.render_pass(seed, paths=paths), sensor)
        return result if develop else mi.TensorXf()

    def render_forward(self, *args: Any, **kwargs: Any) -> mi.TensorXf:
        """Raise UserError: Mitsuba's gradients do not pass through scattering."""
        raise UserError(
            f"{self.plugin} passes no gradients of Mitsuba: render without parameters that track them, and with "
            "mitransient_lidar.render(..., derivatives=[...]) for derivatives"
        )

    render_backward = render_forward


class LidarPassIntegrator(PassIntegrator):
    """Integrator of lidar echoes."""

    @abstractmethod
    def renderer(
        self, lidar: LidarScene, classes: PathClasses, layout_of: PassRenderer | None, connections: bool
    ) -> PassRenderer:
        """Return the pass renderer for the parts of a scene; other arguments as for `prepare`."""

    def prepare(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        *,
        classes: PathClasses | None = None,
        receiver: Receiver | None = None,
        layout_of: PassRenderer | None = None,
        connections: bool = True,
        axis: TimeAxis | None = None,
    ) -> PassRenderer:
        """Return the pass renderer for a scene, by default with one light class and the sensor's own receiver.

        `axis` gives the start or number of time bins that the film leaves to the scene. Without it they contain all
        light (`find_lidar_scene`).

        `layout_of` is another scene's renderer, whose time bins, points and cells are used. Scenes that differ by a
        target, or slightly in a parameter, then make the same paths from the same seeds. Without `connections`, paths
        that miss the target return the same light with and without it, except for light in full cells. Errors with
        narrow beams are larger.

        Raises UserError when the scene lacks a part or has one that is not supported.
        """
        axis = axis if layout_of is None else layout_of.scene.axis
        lidar = find_lidar_scene(scene, sensor, receiver, axis=axis)
        return self.renderer(lidar, classes or PathClasses(), layout_of, connections)


@register("integrator", LIDAR_MERGING)
class LidarMerging(LidarPassIntegrator):
    r"""Bidirectional transient volumetric integrator (``lidar_merging``).

    .. parameters::

    Nearly every echo has one vertical reversal, and both parts of its path are easy to sample from their own ends.
    Light paths start at the laser and receiver paths at the receiver. Both cross waves and ripples into the water,
    scatter to any order, and get points at equal distances. A light point and a receiver point in the same small cell
    are merged into a complete path, with the phase function between their directions. The same small patch on the
    bottom or on a target merges them with the BSDF (photon mapping in a medium: Jensen and Christensen 1998,
    doi:10.1145/280814.280925; points at equal distances instead of collisions: the track-length estimator, Spanier
    1966, doi:10.1137/0114057, at both ends).

    Cells are sectors of rings about the refracted beam, in layers below the surface. With the distance *r* from the
    axis and a core radius *q* of two beam standard deviations plus 0.05 m per metre of depth, rings have equal widths
    in arsinh(*r*/*q*). Cells are thus small where the light is concentrated, and grow with the distance from a narrow
    beam. Their thickness is half the point distance, at most 0.3 attenuation lengths. They are thinner near the surface
    where a narrow beam spreads fast, where facets are small, and in turbid water. Patches on solids that look up or
    down are such sectors, too. On the axis they grow with depth at most twice as much as unscattered light.

    Within a cell, light is counted where it meets a common plane, at a random depth in each pass. The receiver's paths
    look it up where the light at their points would meet that plane. This is along the beam as the facet above refracts
    it, at an offset that grows as ripples spread the beam. Narrow beams thus stay sharp, however waves refract them.

    In images with 4096 pixels or more, every second receiver path is merged in the water, with double weight. All are
    merged on solids, whose pixels need more paths.

    Some receiver points are connected with a random light point or with light on a solid. A segment in the water joins
    them over any distance. Light that is scattered into or out of a narrow beam far from the axis rarely meets a small
    cell. Connections find it (Georgiev et al. 2012, doi:10.1145/2366145.2366211).

    A path with several scattering events can arise from a merge at each of them. It can also arise from a connection
    between any two that follow each other. The balance heuristic (Veach and Guibas 1995, doi:10.1145/218380.218498)
    weights all. With coefficient :math:`b_i`, phase function :math:`p_i` and cell volume :math:`V_i` at each event, the
    length :math:`d_i` and the transmittance of scattering :math:`T_i` of the segment to the next one, and the share
    :math:`\kappa` of the pairs of points that are connected, each pair of points of weights *w* and *w'* adds

    .. math::

        w\, w' \Big(\sum_i \frac{V_i}{b_i p_i}
        + \kappa \sum_i \frac{d_i^2}{b_i p_i\, T_i\, b_{i+1} p_{i+1}}\Big)^{-1},

    which is bounded by the event of the smallest :math:`b_i p_i`, so that the forward peak does not cause noise. Paths
    that meet a solid are merged only at the first one from the receiver, or connected to it from the last
    scattering event before. There are no connections in water with bubbles or with several refractive indices, nor
    under water.

    Around a laser under water, cells are shells cut into rings and sectors about its axis. They are thinner and
    narrower near the laser, where light and view are concentrated. Cell volumes differ along a path. With the cell
    volume :math:`v_i` at each event, the merge at event *k* has the weight :math:`(v_k / b_k p_k) / \sum_i v_i / (b_i
    p_i)`.

    Echoes from the surface and from solids in the air are connected to the laser directly. ``lidar_volpath`` with
    ``complement_only`` adds all other paths, such as light that meets the sea twice without scattering, mirrors under
    water, and reflected solids in the air.

    Cells end above the first solid below the surface. Other cells begin below a solid that lets a share of the light
    pass, such as a mask or a pane. Through a second such solid they blur the light by their thickness.

    Cells blur the light by their width where waves focus both beam and field of view. With ``ripple_focusing``, a
    factor restores the mean over seas. Cells follow the surface and are sheared along the beam. Times and absorption
    are taken at the receiver's point. Patches cut by edges count by their covered share. Over 6 m/s waves, the
    published geometry's water signal differs from the reference by 0.04 +- 0.12 % in the first metre and 0.01 +- 0.06 %
    below. At 75 degrees over 3 m/s waves, it differs by -1.4 +- 0.6 and -0.5 +- 0.5 %. A 1 mrad beam at 40 degrees over
    10 m/s meets several facets. It differs by -2 +- 1 % from 1 to 2 ns after its first light, and by -0.1 +- 0.1 % in
    the column. Wider cells (``cell_size``) have more bias in the first metre. A beam may be up to 1000 attenuation
    lengths wide. Derivatives come from `mitransient_lidar.render`, not from Mitsuba's gradients.

    .. example::

        {'type': 'lidar_merging'}
    """

    plugin = "lidar_merging"

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props)
        given = [name for name in ("paths_per_pass", "photons_per_pass") if name in props]
        counts = {name: props.read(name) for name in given}
        lengths = {name: props.read(name) for name in ("cell_size", "point_spacing")}
        self.options = MergingOptions(**counts, **lengths, solids=props.read("solids"))

    def renderer(
        self, lidar: LidarScene, classes: PathClasses, layout_of: PassRenderer | None, connections: bool
    ) -> PassRenderer:
        """Return the renderer, which connects all light in a scene without water."""
        if lidar.water is None:
            paths = paths_of_pass(self.options, lidar.receiver.pixels.count)
            return VolpathRenderer(lidar, classes, paths, VolpathOptions())
        layout = layout_of.layout if isinstance(layout_of, MergingRenderer) else None
        return MergingRenderer(lidar, classes, self.options, layout, connections)


def volpath_options(props: DeclaredProperties, **others: Any) -> VolpathOptions:
    """Return the path tracer's options, some of which a plugin gives."""
    names = ("max_scatterings", "roulette_threshold", "guiding_probability")
    return VolpathOptions(*map(props.read, names), **others)


@register("integrator", LIDAR_VOLPATH)
class LidarVolpath(LidarPassIntegrator):
    r"""Transient volumetric path tracer with surface connection (``lidar_volpath``).

    .. parameters::

    The unbiased reference. Paths start at the receiver, cross the surface (waves and ripples), scatter to any order,
    meet bottom and targets, and are reflected inside the surface. No path meets a point laser by chance. Each vertex
    under water therefore samples a direction in which the laser may appear through a flat sea with the same total slope
    variance. It traces this direction to the real surface, and connects there. A path that reaches the surface
    unscattered is connected there, too. Both estimate the same paths; the balance heuristic combines them (Veach and
    Guibas 1995, doi:10.1145/218380.218498).

    Straight lines connect a laser under water. Its light reaches a scattering event from one direction, so that phase
    functions with a strong forward peak make rare, large values. In multiple scattering from a narrow beam, the
    standard errors are thus too small and the means mostly too low. ``lidar_merging`` does not have this limit.

    Every segment is timed with the group index of the medium that it crosses. Derivatives come from
    `mitransient_lidar.render`, not from Mitsuba's gradients.

    .. example::

        {'type': 'lidar_volpath', 'paths_per_pass': 262144}
    """

    plugin = "lidar_volpath"

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props)
        self.paths_per_pass = props.read("paths_per_pass")
        self.options = volpath_options(props, complement_only=props.read("complement_only"))

    def renderer(
        self, lidar: LidarScene, classes: PathClasses, layout_of: PassRenderer | None, connections: bool
    ) -> VolpathRenderer:
        """Return the renderer: it has no cells, and always connects."""
        return VolpathRenderer(lidar, classes, self.paths_per_pass, self.options)


@register("integrator", PASSIVE_VOLPATH)
class PassiveVolpath(PassIntegrator):
    r"""Volumetric path tracer for images by daylight (``passive_volpath``).

    .. parameters::

    Renders each pixel's radiance [W m^-2 sr^-1 nm^-1]. Paths start uniformly over the field of view and are traced as
    in ``lidar_volpath``. The sun replaces the laser: each path is connected to one point on the sun's disc. Paths that
    leave the scene meet the sky. A separate ray samples the sky that the sea reflects, as few paths are reflected.

    The sea must be rough, as every ``ocean_surface`` is. Through a smooth ``dielectric`` paths meet the sun's disc only
    by chance, and the image is noisy. Distances to scattering events are drawn from the scattering coefficient, and
    absorption is a weight.

    Light that the water scatters towards the receiver causes most of the noise, and varies slowly over an image. The
    option ``smooth`` of `mitransient_lidar.render_passive` smooths this part alone.

    Light from outside the surface mesh is lost. The air is clear; the receiver's optics do not affect the radiance.
    There are no derivatives.

    .. example::

        {'type': 'passive_volpath', 'paths_per_pass': 262144}
    """

    plugin = "passive_volpath"
    passive = True

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props)
        self.paths_per_pass = props.read("paths_per_pass")
        self.options = volpath_options(
            props,
            solid_guiding_probability=props.read("solid_guiding_probability"),
            expects_emitter=True,
            weights_absorption=True,
        )

    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> DaylightRenderer:
        """Return the pass renderer for a scene; raise UserError when a part is missing or not supported."""
        return DaylightRenderer(DaylightScene.from_scene(scene, sensor), self.options, self.paths_per_pass)

    def develop(self, received: ReceivedDaylight, sensor: mi.Sensor) -> mi.TensorXf:
        """Return the radiance [W m^-2 sr^-1 nm^-1] of a pass, 0 where no path started."""
        pixels = sensor.receiver.pixels
        radiance = dr.select(received.sampled > 0, received.found / received.sampled, 0)
        return mi.TensorXf(mi.Float(radiance), shape=pixels.grid or (pixels.count,))
