"""Plant leaves on a bottom: blades that stand on it, or a layer of random leaves, and their gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, require_memory

#: Memory of a leaf: its two triangles, their copy in Mitsuba and the tree in which rays meet them [bytes].
_BYTES_PER_LEAF = 500

#: Leaf corners in half widths and shares of the length, and its triangles.
_CORNERS = (-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0)
_TRIANGLES = (0, 1, 2), (0, 2, 3)


@dataclass(frozen=True)
class Canopy:
    """Leaves in a layer over a bottom.

    Leaves lie at random locations. Light at the angle theta from the vertical passes them unhindered with the
    probability exp(-G L / cos theta), for the leaf area index L and the mean leaf projection G on that direction
    (Nilson 1971, Agric. Meteorol. 8, 25, doi:10.1016/0002-1571(71)90092-6).
    """

    leaf_area_index: float  #: One-sided leaf area per bottom area, above 0.
    height: float  #: Height of the tips above the bottom [m], above 0.
    leaf_width: float  #: Leaf width [m]; without blades the side of a square leaf.
    #: Blade angle from the vertical [rad], 0 to 1.4; None for square leaves that look in all directions alike,
    #: everywhere in the layer.
    bending: float | None = None
    bending_azimuth: float | None = None  #: Azimuth towards which blades lean, from +x to +y [rad]; None for any.
    #: Shoots per area [1/m^2], whose blades stand at one location; None for blades that stand alone.
    shoot_density: float | None = None

    def __post_init__(self) -> None:
        if self.leaf_width > self.height:
            raise UserError(f"leaf_width = {self.leaf_width:g} must be at most height = {self.height:g}")
        if self.shoot_density is not None and self.shoot_density > self.density:
            raise UserError(
                f"shoot_density = {self.shoot_density:g} must be at most {self.density:.4g} blades per square metre "
                f"of leaf_area_index = {self.leaf_area_index:g}"
            )

    @property
    def leaf_length(self) -> float:
        """Leaf length [m]."""
        return self.leaf_width if self.bending is None else self.height / math.cos(self.bending)

    @property
    def density(self) -> float:
        """Leaves per bottom area [1/m^2]."""
        return self.leaf_area_index / (self.leaf_length * self.leaf_width)

    def projection(self, zenith: float) -> float:
        """Return the mean projection of leaves on a direction at an angle from the vertical [rad].

        1/2 for leaves that look in all directions alike; 2/pi times the mean sine of the angle to blades that lean in
        any direction and face any way (Warren Wilson 1960, doi:10.1111/j.1469-8137.1960.tb06210.x).
        """
        if self.bending is None:
            return 0.5
        azimuth = np.linspace(0, np.pi, 2000, endpoint=False) + np.pi / 4000
        cosine = np.cos(zenith) * np.cos(self.bending) + np.sin(zenith) * np.sin(self.bending) * np.cos(azimuth)
        return float(2 / np.pi * np.sqrt(1 - cosine**2).mean())

    def gap_probability(self, zenith: float) -> float:
        """Return the probability that light passes the layer at an angle from the vertical [rad], below pi/2.

        Blades lean in any direction, and stand alone.
        """
        return math.exp(-self.projection(zenith) * self.leaf_area_index / math.cos(zenith))

    def leaves(self, side: float, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return leaves on a level square about x = y = 0 at z = 0, drawn at random.

        Raises UserError if they exceed the memory.

        `side`: side of the square that contains the blades, or the leaf centres [m]. `seed`: random seed.

        Returns `feet`, `width`, `length`: middle of each leaf's lower edge [m], and vectors along that edge and away
        from it, as long as the leaf is wide and long [m]; shape (leaves, 3).
        """
        count = round(self.density * side * side)
        what = f"{count} leaves of leaf_area_index = {self.leaf_area_index:g} within size = {side:g} m"
        require_memory(what, _BYTES_PER_LEAF * count, "take a smaller size or a larger leaf_width")
        rng = np.random.default_rng(seed)
        shoots = count if self.shoot_density is None else max(round(self.shoot_density * side * side), 1)
        places = rng.uniform(-side / 2, side / 2, (shoots, 2))
        # Shoots have equal numbers of blades, but for a remainder.
        feet = np.append(places[np.arange(count) % shoots], np.zeros((count, 1)), axis=1)
        if self.bending is None:
            cosine = rng.uniform(0, 1, count)
            normal = _directions(np.arccos(cosine), rng.uniform(0, 2 * np.pi, count))
            length = _across(normal, rng.uniform(0, 2 * np.pi, count))
            feet[:, 2] = rng.uniform(0, self.height, count)
            width = np.cross(length, normal)
            return feet - 0.5 * self.leaf_length * length, self.leaf_width * width, self.leaf_length * length
        azimuth = rng.uniform(0, 2 * np.pi, count)
        if self.bending_azimuth is not None:
            azimuth = np.full(count, self.bending_azimuth)
        length = _directions(np.full(count, self.bending), azimuth)
        width = _across(length, rng.uniform(0, 2 * np.pi, count))
        return feet, self.leaf_width * width, self.leaf_length * length


def leaf_triangles(feet: FloatArray, width: FloatArray, length: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return vertices [m], shape (4 n, 3), and the triangles of n leaves as `Canopy.leaves` returns them, (2 n, 3)."""
    corners = [feet + across * width + along * length for across, along in _CORNERS]
    first = 4 * np.arange(len(feet))[:, None, None]
    return np.stack(corners, axis=1).reshape(-1, 3), (first + np.array(_TRIANGLES)).reshape(-1, 3)


def _directions(zenith: FloatArray, azimuth: FloatArray) -> FloatArray:
    """Return unit vectors at angles from the vertical and from +x towards +y [rad], shape (n, 3)."""
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)


def _across(axis: FloatArray, roll: FloatArray) -> FloatArray:
    """Return unit vectors across unit vectors of shape (n, 3), turned about them by angles [rad]."""
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(axis, first)
    return np.asarray(np.cos(roll)[:, None] * first + np.sin(roll)[:, None] * second)
