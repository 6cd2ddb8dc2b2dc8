"""Horizontally stratified water: inherent optical properties and optical depths of layers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.water import LAYERED_WATER
from mitransient_lidar.core.validation import FloatArray, non_negative_array, number_list

LayerValues = float | str | Sequence[float] | FloatArray


@dataclass(frozen=True, eq=False)
class WaterColumn:
    """Water in horizontal layers, each with constant properties.

    Depth is positive downwards from the mean sea level. The first layer also fills everything above z = 0 (wave
    crests); the last is unbounded below. A layer owns its upper edge.

    Raises UserError if a value is not finite or negative, the lengths differ, the layers are out of order, or bb <= b
    <= c fails.

    `layer_tops`: depth of each layer's upper edge [m], shape (L,). The first is 0 and they increase strictly.
    `attenuation`: beam attenuation coefficient c [1/m], at least `scattering`, at most 1000, shape (L,). `scattering`:
    scattering coefficient b [1/m], at least `backscattering`, shape (L,). `backscattering`: backscattering coefficient
    bb [1/m], the part of b into the backward hemisphere, at least 0, shape (L,).
    """

    layer_tops: FloatArray
    attenuation: FloatArray
    scattering: FloatArray
    backscattering: FloatArray

    def __post_init__(self) -> None:
        for name in ("layer_tops", "attenuation", "scattering", "backscattering"):
            values = non_negative_array(name, getattr(self, name))
            if values.ndim != 1 or values.size == 0:
                raise UserError(f"{name} of shape {values.shape} must be a list of one value per layer")
            if values.size != np.size(self.layer_tops):
                raise UserError(f"{name} has {values.size} values but layer_tops has {np.size(self.layer_tops)} layers")
            LAYERED_WATER[name].number(values.max())
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if self.layer_tops[0] != 0:
            raise UserError(f"layer_tops starts at {self.layer_tops[0]:g} m but the first layer must start at 0 m")
        if np.any(np.diff(self.layer_tops) <= 0):
            raise UserError(
                f"layer_tops = {self.layer_tops.tolist()} has layers out of order: depths must increase strictly"
            )
        _must_not_exceed("scattering", self.scattering, "attenuation", self.attenuation)
        _must_not_exceed("backscattering", self.backscattering, "scattering", self.scattering)

    @classmethod
    def from_text(
        cls, layer_tops: LayerValues, attenuation: LayerValues, scattering: LayerValues, backscattering: LayerValues
    ) -> WaterColumn:
        """Build from numbers, sequences, or strings of numbers separated by commas or spaces.

        A single coefficient value applies to all layers. Parameters and units as for the class.

        Raises UserError as for the class, or if a string contains anything else than numbers.
        """
        edges = number_list("layer_tops", layer_tops)
        coefficients = {"attenuation": attenuation, "scattering": scattering, "backscattering": backscattering}
        columns = [number_list(name, values) for name, values in coefficients.items()]
        return cls(edges, *(np.full(edges.size, c[0]) if c.size == 1 else c for c in columns))

    @property
    def count(self) -> int:
        """Number of layers."""
        return int(self.layer_tops.size)

    @property
    def absorption(self) -> FloatArray:
        """Absorption coefficient a = c - b [1/m], shape (L,)."""
        return self.attenuation - self.scattering

    @property
    def albedo(self) -> FloatArray:
        """Single-scattering albedo b/c, shape (L,); 0 where c is 0."""
        return _ratio(self.scattering, self.attenuation)

    @property
    def backscatter_ratio(self) -> FloatArray:
        """Backscattered fraction bb/b, shape (L,); 0 where b is 0."""
        return _ratio(self.backscattering, self.scattering)

    @property
    def edge_optical_depth(self) -> FloatArray:
        """Vertical optical depth from z = 0 to each upper edge, shape (L,); the first is 0."""
        return np.concatenate(([0.0], np.cumsum(self.attenuation[:-1] * np.diff(self.layer_tops))))

    def layer_at(self, depth: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Index of the layer at `depth` [m]; also 0 above the mean sea level."""
        return np.maximum(np.searchsorted(self.layer_tops, np.asarray(depth, dtype=np.float64), side="right") - 1, 0)

    def cumulative(self, depth: npt.ArrayLike) -> FloatArray:
        """Vertical optical depth from z = 0 to `depth` [m]: piecewise linear, negative above the mean sea level."""
        z = np.asarray(depth, dtype=np.float64)
        layer = self.layer_at(z)
        return np.asarray(self.edge_optical_depth[layer] + self.attenuation[layer] * (z - self.layer_tops[layer]))

    def depth_of(self, optical_depth: float) -> float:
        """Return the depth [m] down to which the water has an optical depth; the last layer's edge if it never has."""
        layer = int(np.searchsorted(self.edge_optical_depth, optical_depth, side="right")) - 1
        edge, attenuation = self.edge_optical_depth[layer], self.attenuation[layer]
        return float(self.layer_tops[layer] + ((optical_depth - edge) / attenuation if attenuation > 0 else 0.0))

    def optical_depth_of_scattering(self, depth: npt.ArrayLike) -> FloatArray:
        """Vertical optical depth of scattering from z = 0 to `depth` [m], not negative."""
        ends = np.clip(np.asarray(depth, dtype=np.float64)[..., np.newaxis], self.layer_tops, self._layer_ends)
        return np.asarray((ends - self.layer_tops) @ self.scattering)

    def layer_shares(self, depth: npt.ArrayLike) -> FloatArray:
        """Share of each layer in the water from z = 0 to `depth` [m], shape (..., L).

        At or above the mean sea level all is the first layer. At an unknown depth (NaN) a single layer has its usual
        share, and several layers have NaN.
        """
        z = np.asarray(depth, dtype=np.float64)[..., np.newaxis]
        if self.count == 1:
            return np.ones(z.shape)
        thickness = np.clip(z, self.layer_tops, self._layer_ends) - self.layer_tops
        first = np.arange(self.count) == 0
        return np.where(z > 0, thickness / np.where(z > 0, z, 1.0), np.where(np.isnan(z), np.nan, first))

    @property
    def _layer_ends(self) -> FloatArray:
        """Lower layer edges [m]."""
        return np.append(self.layer_tops[1:], np.inf)

    def optical_depth(self, depth0: npt.ArrayLike, depth1: npt.ArrayLike, distance: npt.ArrayLike) -> FloatArray:
        """Optical depth of straight segments.

        `depth0`, `depth1`: depths of the two ends [m], in any order. `distance`: length of the segment [m], at least
        abs(depth1 - depth0).

        Result: optical depth, in the broadcast shape. A horizontal segment lies in the layer that owns its depth.
        """
        z0, z1, length = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (depth0, depth1, distance)))
        upper, lower = np.minimum(z0, z1), np.maximum(z0, z1)
        drop = lower - upper
        # Path fractions by layer from clipped edges: differences of cumulative() cancel on nearly level segments.
        starts = np.concatenate(([-np.inf], self.layer_tops[1:]))
        ends = np.concatenate((self.layer_tops[1:], [np.inf]))
        inside = np.maximum(np.minimum(lower[..., None], ends) - np.maximum(upper[..., None], starts), 0)
        slanted = inside @ self.attenuation / np.where(drop > 0, drop, 1)
        return np.asarray(np.where(drop > 0, slanted, self.attenuation[self.layer_at(upper)]) * length)


def _ratio(part: FloatArray, total: FloatArray) -> FloatArray:
    """Return part/total, 0 where the total is 0."""
    return np.divide(part, total, out=np.zeros_like(total), where=total > 0)


def _must_not_exceed(name: str, part: FloatArray, total_name: str, total: FloatArray) -> None:
    """Reject a part that exceeds its total."""
    for layer in np.flatnonzero(part > total)[:1]:
        where = f" in layer {layer}" if part.size > 1 else ""
        raise UserError(f"{name} = {part[layer]:g} must not exceed {total_name} = {total[layer]:g}{where}")
