"""Base of the integrator plugins."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError


class LidarIntegrator(mi.CppADIntegrator):
    """Integrator that prepares a scene and renders one pass of it.

    It keeps nothing of a scene: every call of ``mi.render`` finds and lays out the scene as it is then, edits with
    ``mi.traverse`` included. ``mitransient_lidar.render`` prepares a scene once for all of its passes.
    """

    #: Name under which results record the integrator.
    plugin: str

    #: Whether it renders daylight instead of a lidar's echoes.
    passive = False

    @abstractmethod
    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> Any:
        """Return the renderer of passes of a scene (`PassRenderer` or `DaylightRenderer`).

        Raises
        ------
        UserError
            When the scene lacks a part or holds one that the integrator does not support.
        """

    @abstractmethod
    def develop(self, record: Any, sensor: mi.Sensor) -> mi.TensorXf:
        """Return what a pass recorded as Mitsuba's users expect it."""

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render one pass.

        Parameters
        ----------
        scene, sensor
            Scene, and sensor or its index.
        seed
            Seed of the pass; passes of different seeds are independent.
        spp
            Paths for each pixel; 0 takes the integrator's number of paths for all pixels together.
        develop
            Whether to return the result, or an empty tensor.
        evaluate
            Not used: passes are always computed at once.

        Returns
        -------
        TensorXf
            Received energy [J], shape (pixel, time) or (row, column, time); by daylight radiance [W m^-2 sr^-1 nm^-1],
            shape (pixel,) or (row, column), 0 where no path started.
        """
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        renderer = self.prepare(scene, sensor)
        paths = spp * renderer.scene.receiver.pixels.count if spp > 0 else None
        result = self.develop(renderer.render_pass(int(np.array(seed).item()), paths=paths), sensor)
        return result if develop else mi.TensorXf()

    def render_forward(self, *args: Any, **kwargs: Any) -> mi.TensorXf:
        """Refuse derivatives.

        Raises
        ------
        UserError
            Always.
        """
        raise UserError(f"{self.plugin} has no derivatives: render without parameters that track gradients")

    def render_backward(self, *args: Any, **kwargs: Any) -> None:
        """Refuse derivatives; raise UserError as `render_forward`."""
        self.render_forward()
