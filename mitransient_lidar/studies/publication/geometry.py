"""Statements about the geometry: figures 5, 8 and 12."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.loading.catalogue import scene_parameters
from mitransient_lidar.physics.lidar.lidar_geometry import LidarGeometry
from mitransient_lidar.rendering.shots.truth import Shot
from mitransient_lidar.studies.publication.renders import Renders
from mitransient_lidar.studies.publication.statements import Statement
from mitransient_lidar.studies.shot_statistics import depth_bias
from mitransient_lidar.transport.sensor.outlines import enclosed_area, pixel_outlines

#: Scenes of the pixel layouts that figure 8 shows.
LAYOUT_SCENES = ("fig09_1x1", "fig09_2x2", "fig14_1x4")

#: Scenes of the three shots on waves.
SHOT_SCENES = ("fig11_shot1", "fig11_shot2", "fig11_shot3")

#: Angle in the water by the publication's formula at 20 degrees and a refractive index of 1.34 [degree].
_PUBLISHED_ANGLE = math.degrees(math.asin(math.sin(math.radians(20)) / 1.34))

#: Least field of view of the publication's table 1 [rad].
_LEAST_FIELD_OF_VIEW = 0.010


@dataclass(frozen=True, kw_only=True)
class System(LidarGeometry):
    """Lidar of a scene: divergence and field of view [rad], and depth of the bottom [m]."""

    divergence: float
    field_of_view: float
    bottom_depth: float

    @classmethod
    def of(cls, scene: str) -> System:
        """Read the parameters of a scene."""
        values = scene_parameters(scene)
        return cls(
            float(values["altitude"]),
            math.radians(float(values["off_nadir_deg"])),
            *(float(values[name]) for name in ("refractive_index", "group_index")),
            divergence=1e-3 * float(values["divergence_mrad"]),
            field_of_view=1e-3 * float(values["field_of_view_mrad"]),
            bottom_depth=float(values["bottom_depth"]),
        )


def outlines(renders: Renders, scene: str) -> list[list[FloatArray]]:
    """Return the outlines (angle_x, angle_y) [rad] of each pixel of a scene."""
    return [list(lines) for lines in pixel_outlines(renders.session(scene).sensor.receiver.pixels)]


def shot_places(renders: Renders) -> list[Shot]:
    """Return places and mean slopes over the footprint of the beam of the three shots, which share one sea."""
    sea, found = renders.sea(SHOT_SCENES[0]), []
    for number, scene in enumerate(SHOT_SCENES, start=1):
        values = scene_parameters(scene)
        x, y = float(values["aim_x"]), float(values["aim_y"])
        found.append(Shot(f"shot {number}", x, y, *sea.slope_at(x, y)))
    return found


def shot_slopes(renders: Renders) -> list[tuple[float, float]]:
    """Return the mean slopes (along, across) [1] of the three shots."""
    return [(shot.along, shot.across) for shot in shot_places(renders)]


def system_statements(_renders: Renders) -> list[Statement]:
    """Return the statements about the system (figure 5)."""
    system = System.of("fig09_2x2")
    angle = math.degrees(system.angle_in_water)
    spot = system.slant_range * system.divergence
    where = "parameters of the scene fig09_2x2, level sea"
    narrow = _LEAST_FIELD_OF_VIEW * system.slant_range
    return [
        Statement(
            "fig05",
            "Snell's law with the ratio of the velocities of light gives the angle in the water",
            "angle of the axis from the vertical in the water (degree)",
            f"{_PUBLISHED_ANGLE:.2f}",
            angle,
            0.0,
            (_PUBLISHED_ANGLE - 0.01, _PUBLISHED_ANGLE + 0.01),
            where,
        ),
        Statement(
            "fig05",
            "the laser's footprint on the sea is 1 to 2 m",
            "diameter of the footprint at e^-1/2 of the peak, across the beam (m)",
            "1 to 2",
            spot,
            0.0,
            (1.0, 2.0),
            where,
            difference="the least divergence of table 1 times the slant range; 1 to 2 m are the footprints of slant "
            f"ranges of {1 / system.divergence:.0f} to {2 / system.divergence:.0f} m",
        ),
        Statement(
            "fig05",
            "the field of view on the sea is wider than 2 m",
            "diameter of a field of view of 10 mrad on the sea, across the axis (m)",
            "> 2",
            narrow,
            0.0,
            (2.0, np.inf),
            where,
        ),
    ]


def pixel_statements(renders: Renders) -> list[Statement]:
    """Return the statements about the shapes of the pixels (figure 8)."""
    areas = [sum(abs(enclosed_area(line)) for line in lines) for lines in outlines(renders, "fig14_1x4")]
    return [
        Statement(
            "fig08",
            "the outer strips of 1x4 pixels have smaller fields of view than the inner ones",
            "solid angle of red over that of green",
            "< 1",
            areas[0] / areas[1],
            0.0,
            (0.0, 1.0),
            "areas of the traced outlines of the pixels of fig14_1x4",
        )
    ]


def path_statements(renders: Renders) -> list[Statement]:
    """Return the statement about paths below a slope (figure 12)."""
    system, slopes = System.of(SHOT_SCENES[0]), shot_slopes(renders)
    along = np.array([pair[0] for pair in slopes])
    bias = depth_bias(along, system.bottom_depth, system.off_nadir, system.refractive_index)
    degrees = ", ".join(f"{value:.1f}" for value in np.degrees(np.arctan(along)))
    return [
        Statement(
            "fig12",
            "below a slope that faces away from the lidar the path to the bottom is shorter, which explains the bias",
            "depth by refraction of the axis at the mean slope of shot 3, less that of shots 1 and 2 (m)",
            "about -0.1",
            float(bias[2] - bias[:2].mean()),
            0.0,
            (-0.15, -0.05),
            f"Snell's law at the slopes {degrees} degrees of shots 1 to 3, bottom at {system.bottom_depth:g} m",
            difference="refraction at the mean slope has the right sign and is a part of the bias; the rest is the "
            "shape of the waves in the footprint",
        )
    ]
