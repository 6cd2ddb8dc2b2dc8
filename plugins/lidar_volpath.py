"""Integrator plugin ``lidar_volpath``: unidirectional, transient, unbiased."""

from __future__ import annotations

from typing import Any

from mitransient_lidar.core.parameters.integrators import LIDAR_VOLPATH
from mitransient_lidar.plugins.bases import DeclaredProperties, LidarPassIntegrator, register
from mitransient_lidar.transport.paths.passes import PassRenderer
from mitransient_lidar.transport.paths.path_classes import PathClasses
from mitransient_lidar.transport.paths.volpath import VolpathOptions, VolpathRenderer
from mitransient_lidar.transport.scene import LidarScene


def volpath_options(props: DeclaredProperties, **others: Any) -> VolpathOptions:
    """Return the path tracer's options, some of which a plugin gives."""
    names = ("max_scatterings", "roulette_threshold", "guiding_probability")
    return VolpathOptions(*map(props.read, names), **others)


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


register("integrator", LIDAR_VOLPATH, LidarVolpath)
