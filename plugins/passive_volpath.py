"""Integrator plugin ``passive_volpath``: images by daylight."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.parameters.integrators import PASSIVE_VOLPATH
from mitransient_lidar.plugins.bases import DeclaredProperties, PassIntegrator, register
from mitransient_lidar.plugins.lidar_volpath import volpath_options
from mitransient_lidar.transport.daylight.renderer import DaylightRenderer, ReceivedDaylight
from mitransient_lidar.transport.daylight.scene import DaylightScene


class PassiveVolpath(PassIntegrator):
    r"""Volumetric path tracer for images by daylight (``passive_volpath``).

    .. parameters::

    Renders each pixel's radiance [W m^-2 sr^-1 nm^-1]. Paths start uniformly over the field of view and are traced as
    in ``lidar_volpath``. The sun replaces the laser: each path is connected to one point on the sun's disc. Paths that
    leave the scene meet the sky. A separate ray samples the sky that the sea reflects, as few paths are reflected.

    The sea must be rough, as every ``ocean_surface`` is: through a smooth ``dielectric`` paths meet the sun's disc only
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


register("integrator", PASSIVE_VOLPATH, PassiveVolpath)
