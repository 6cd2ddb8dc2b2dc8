"""Snell's law for Dr.Jit arrays."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def refract(direction: mi.Vector3f, normal: mi.Normal3f, eta: mi.Float | float) -> mi.Vector3f:
    """Refract at a facet: return the unit direction, beyond the facet, from which light arrives at it.

    Parameters
    ----------
    direction
        Unit direction from the facet to the light source, on the side of the normal.
    normal
        Unit normal of the facet.
    eta
        Refractive index on the side of the normal over the index beyond, at most 1.
    """
    cosine = dr.dot(direction, normal)
    root = dr.safe_sqrt(1 - eta * eta * (1 - cosine * cosine))
    return eta * direction + (root - eta * cosine) * mi.Vector3f(normal)


def refract_level(direction: mi.Vector3f, eta: mi.Float | float) -> tuple[mi.Vector3f, mi.Bool]:
    """Return a propagation direction beyond a horizontal plane, and whether light passes it.

    Parameters
    ----------
    direction
        Unit propagation direction.
    eta
        Refractive index before the plane over the index behind it. Where it exceeds 1, light may be totally reflected.
    """
    x, y = direction.x * eta, direction.y * eta
    cosine2 = 1 - x * x - y * y
    return mi.Vector3f(x, y, dr.copysign(dr.safe_sqrt(cosine2), direction.z)), cosine2 > 0
