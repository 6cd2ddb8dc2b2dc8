"""Rotations of roll, pitch and yaw.

Body axes are x to the right, y forward and z up; at zero angles they are the axes of the scene, x east, y north, z up.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray

#: Orders and signs of the three rotations, as factors from the left, of which the last acts first on a vector: name,
#: axis, and sign of the angle (+1: counterclockwise seen against the axis).
_FACTORS = {
    "aerospace": (("yaw", "z", -1), ("pitch", "x", 1), ("roll", "y", 1)),
    "ARINC 705": (("yaw", "z", -1), ("roll", "y", 1), ("pitch", "x", 1)),
    "CANONICAL": (("roll", "x", 1), ("pitch", "y", 1), ("yaw", "z", 1)),
}

#: Their names: the order of inertial navigation, and the two that HELIOS++ calls ``rotationSpec``.
RotationSpec = Literal["aerospace", "ARINC 705", "CANONICAL"]


def rotation_matrices(
    roll_deg: npt.ArrayLike, pitch_deg: npt.ArrayLike, yaw_deg: npt.ArrayLike, rotation_spec: RotationSpec = "aerospace"
) -> FloatArray:
    """Return the matrices that turn vectors of the body into vectors of the scene.

    ``aerospace`` is yaw . pitch . roll: the vector is first turned by roll about the forward axis (positive: right side
    down), then by pitch about the axis to the right (positive: nose up), then by yaw about the downward vertical
    (positive: clockwise from above, so that yaw is the heading from north). ``ARINC 705``, the default of HELIOS++, has
    the same signs but yaw . roll . pitch: pitch acts first. ``CANONICAL`` of HELIOS++ is roll about x, pitch about y
    and yaw about z, all counterclockwise seen against the axis, with yaw acting first.

    Parameters
    ----------
    roll_deg, pitch_deg, yaw_deg
        Angles [deg], shape (n,).
    rotation_spec
        Order of the rotations.

    Returns
    -------
    Rotation matrices, shape (n, 3, 3).
    """
    angles = {"roll": roll_deg, "pitch": pitch_deg, "yaw": yaw_deg}
    first, second, third = (
        _about(axis, sign * np.radians(np.asarray(angles[name], dtype=np.float64)))
        for name, axis, sign in _FACTORS[rotation_spec]
    )
    return np.asarray(first @ second @ third)


def _about(axis: str, angle: FloatArray) -> FloatArray:
    """Return the rotations by angles [rad], shape (n,), counterclockwise seen against an axis, shape (n, 3, 3)."""
    fixed = "xyz".index(axis)
    one, two = (fixed + 1) % 3, (fixed + 2) % 3
    matrices = np.zeros((*angle.shape, 3, 3))
    matrices[..., fixed, fixed] = 1.0
    matrices[..., one, one] = matrices[..., two, two] = np.cos(angle)
    matrices[..., two, one] = np.sin(angle)
    matrices[..., one, two] = -np.sin(angle)
    return matrices
