"""Integrator plugin ``lidar_volpath``: unidirectional, transient, unbiased."""

from __future__ import annotations

import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import in_range, integer
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plugins.bases import PassIntegrator, recorded
from mitransient_lidar.transport.passes import PassRenderer
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.scene_parts import find_lidar_scene
from mitransient_lidar.transport.sensor.receiver import Receiver
from mitransient_lidar.transport.volpath import CONNECTIONS, VolpathOptions, VolpathRenderer


class VolpathIntegrator(PassIntegrator):
    """Integrator with the options of the path tracer; `guiding_probability` is the default."""

    #: Default of the roulette's threshold.
    roulette_threshold = 0.001

    def __init__(self, props: mi.Properties, guiding_probability: float, complement_only: bool = False) -> None:
        super().__init__(props)
        self.paths_per_pass = integer("paths_per_pass", props.get("paths_per_pass", 2**18), 1024, 2**28)
        connection = props.get("connection", "mis")
        if connection not in CONNECTIONS:
            raise UserError(f"connection = {connection!r} must be one of {', '.join(CONNECTIONS)}")
        self.options = VolpathOptions(
            integer("max_scatterings", props.get("max_scatterings", -1), -1, 2**30),
            in_range("roulette_threshold", props.get("roulette_threshold", self.roulette_threshold), 0.0, 1.0),
            in_range("guiding_probability", props.get("guiding_probability", guiding_probability), 0.0, 0.99),
            connection,
            complement_only,
        )

    def to_string(self) -> str:
        """Return a description."""
        return f"{type(self).__name__}[paths_per_pass={self.paths_per_pass}, connection={self.options.connection}]"


class LidarVolpath(VolpathIntegrator):
    r"""Transient volumetric path tracer with surface connection (``lidar_volpath``).

    ===================  =======  ======================================================================================
    Parameter            Type     Meaning
    ===================  =======  ======================================================================================
    paths_per_pass       integer  Paths of one pass, 1024 to 2^28, unless the sample count per pixel (``spp``) is given
                                  to ``mi.render``. Default: 262144
    max_scatterings      integer  Largest number of scattering events in the water, -1 for any. Default: -1
    roulette_threshold   float    Throughput below which Russian roulette begins, 0 to 1. A path that was scattered back
                                  carries little throughput and much signal, so this is low. Default: 0.001
    guiding_probability  float    Probability, at scattering events and at hits of rough solids under water, that the
                                  direction is drawn from a broad lobe towards the laser instead of the phase function
                                  or BSDF, 0 to 0.99: every echo needs one large scattering angle, which is rare.
                                  Default: 0.4
    connection           string   How vertices under water are connected to the laser: ``mis`` (multiple importance
                                  sampling), or for tests ``emitter`` (directions sampled towards the laser) or
                                  ``phase`` (the path's own directions) alone. Default: ``mis``
    complement_only      boolean  Whether to leave out the paths of ``lidar_merging``: echoes of one vertex in the air,
                                  all paths that scatter in the water and meet no solid, and those whose first solid is
                                  under water and not a mirror. Default: false
    ===================  =======  ======================================================================================

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

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, 0.4, bool(props.get("complement_only", False)))

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


mi.register_integrator("lidar_volpath", recorded(LidarVolpath))
