"""Integrator plugin ``lidar_volpath``: unidirectional, transient, unbiased."""

from __future__ import annotations

import mitsuba as mi

from mitransient_lidar.core.parameters.integrators import LIDAR_VOLPATH
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plugins.bases import DeclaredProperties, PassIntegrator, register
from mitransient_lidar.transport.paths.passes import PassRenderer
from mitransient_lidar.transport.paths.path_classes import PathClasses
from mitransient_lidar.transport.paths.volpath import VolpathOptions, VolpathRenderer
from mitransient_lidar.transport.scene_parts import find_lidar_scene
from mitransient_lidar.transport.sensor.receiver import Receiver


class VolpathIntegrator(PassIntegrator):
    """Integrator with the options of the path tracer."""

    def __init__(self, props: DeclaredProperties, complement_only: bool = False) -> None:
        super().__init__(props)
        self.paths_per_pass = props.read("paths_per_pass")
        names = ("max_scatterings", "roulette_threshold", "guiding_probability")
        self.options = VolpathOptions(*map(props.read, names), complement_only=complement_only)


class LidarVolpath(VolpathIntegrator):
    r"""Transient volumetric path tracer with surface connection (``lidar_volpath``).

    .. parameters::

    The unbiased reference. Paths start at the receiver, cross the surface (waves and ripples), scatter to any order,
    meet bottom and targets, and are reflected inside the surface. As no path meets a point laser by chance, each vertex
    under water samples a direction in which the laser may appear through a flat sea of the same total slope variance,
    traces it to the real surface, and connects there; where the path itself reaches the surface unscattered it is
    connected, too. Both estimate the same paths and are combined by the balance heuristic (Veach and Guibas 1995,
    doi:10.1145/218380.218498).

    A laser under water is connected by straight lines. Its light reaches a scattering event from one direction, so that
    phase functions with a strong forward peak make rare, large values: in multiple scattering from a narrow beam, their
    standard errors are too small and their means mostly too low. ``lidar_merging`` does not have this limit.

    Every segment is timed with the group index of the medium that it crosses. Derivatives come from
    `mitransient_lidar.render`, not from Mitsuba's gradients.

    .. code-block:: xml

        <integrator type="lidar_volpath">
            <integer name="paths_per_pass" value="262144"/>
        </integrator>

    .. code-block:: python

        {'type': 'lidar_volpath', 'paths_per_pass': 262144}
    """

    plugin = "lidar_volpath"

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props, props.read("complement_only"))

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
    ) -> VolpathRenderer:
        """Return the renderer of passes of a scene, as `LidarMerging.prepare`; it has no cells, and always connects."""
        axis = axis if layout_of is None else layout_of.scene.axis
        lidar = find_lidar_scene(scene, sensor, receiver, axis=axis)
        return VolpathRenderer(lidar, classes or PathClasses(), self.paths_per_pass, self.options)


register("integrator", LIDAR_VOLPATH, LidarVolpath)
