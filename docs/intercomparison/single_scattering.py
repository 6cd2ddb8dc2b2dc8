"""Closed-form single scattering: an example of a model that takes part, in NumPy alone.

``python docs/intercomparison/single_scattering.py -o my_results`` writes ``my_results/CASE.csv`` for every case. Light
scatters once in the water, or is reflected once by the bottom, and returns along its own ray through a level surface.
Every other scattering event is a loss. Waves, targets and all light with more scatterings are left out, so that this
model is right in the case ``single_scattering`` alone.
"""

from __future__ import annotations

import argparse
import csv
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Case = dict[str, str]

HERE = Path(__file__).parent
#: Speed of light [m/ns].
LIGHT = 0.299792458
#: Rays of the beam along its radius and azimuth, radius of a Gaussian beam in standard deviations, and nodes of depth.
RADII, AZIMUTHS, REACH, DEPTHS = 96, 192, 6.0, 6


def read_cases() -> dict[str, Case]:
    """Return each case's parameters, as text; parameters that a case does not use are left out."""
    with (HERE / "cases.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [name for name in rows[0] if name not in ("parameter", "unit", "meaning")]
    return {name: {row["parameter"]: row[name] for row in rows if row[name]} for name in names}


def backward_phase(case: Case, layer: int) -> float:
    """Return the phase function at 180 degrees [1/sr]."""
    if case["phase_function"] == "hg":
        g = float(case["phase_g"])
        return (1 - g) / (4 * np.pi * (1 + g) ** 2)
    table = np.genfromtxt(HERE / "fournier_forand.csv", delimiter=",", names=True, deletechars="")
    backscattering, scattering = (numbers(case[key])[layer] for key in ("backscattering", "scattering"))
    return float(table[f"bb_b_{backscattering / scattering:.4g}"][-1])


def numbers(text: str) -> FloatArray:
    """Return the numbers of a list such as "0, 3"."""
    return np.array([float(part) for part in text.split(",")])


def rays(case: Case) -> tuple[FloatArray, FloatArray]:
    """Return angles from the vertical [rad] and weights [1] for beam rays within the field of view."""
    width, view = 1e-3 * float(case["divergence_mrad"]) / 2, 1e-3 * float(case["field_of_view_mrad"]) / 2
    gaussian = case["beam_profile"] == "gaussian"
    end = min(view, REACH * width if gaussian else width)
    nodes, weights = np.polynomial.legendre.leggauss(RADII)
    radius, step = end * (1 + nodes) / 2, end * weights / 2
    shape = np.exp(-0.5 * (radius / width) ** 2) / (2 * np.pi * width**2) if gaussian else 1 / (np.pi * width**2)
    azimuth = 2 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    weight = (shape * radius * step)[:, None] * np.full(AZIMUTHS, 2 * np.pi / AZIMUTHS)
    along, across = radius[:, None] * np.cos(azimuth), radius[:, None] * np.sin(azimuth)
    axis = np.radians(float(case["off_nadir_deg"]))
    horizontal = np.hypot(np.sin(axis) + along * np.cos(axis), across)
    return np.arctan2(horizontal, np.cos(axis) - along * np.sin(axis)).ravel(), weight.ravel()


def transmittance(theta: FloatArray, phi: FloatArray, index: float) -> FloatArray:
    """Return Fresnel's transmittance of unpolarised light [1]."""
    air, water = np.cos(theta), np.cos(phi)
    perpendicular = (air - index * water) / (air + index * water)
    parallel = (index * air - water) / (index * air + water)
    return np.asarray(1 - (perpendicular**2 + parallel**2) / 2)


def energies(case: Case) -> FloatArray:
    """Return each gate's energy [J], shape (gates,)."""
    height, index, group = (float(case[key]) for key in ("altitude", "refractive_index", "group_index"))
    edges = float(case["time_start_ns"]) + float(case["bin_width_ns"]) * np.arange(int(case["bin_count"]) + 1)
    tops, attenuation, scattering = (numbers(case[key]) for key in ("layer_tops", "attenuation", "scattering"))
    theta, weight = rays(case)
    phi = np.arcsin(np.sin(theta) / index)
    # Energy that enters the water and returns to the aperture.
    sent = 1e-3 * float(case["pulse_energy_mj"]) * float(case["aperture_area"])
    weight = sent * weight * transmittance(theta, phi, index) ** 2

    def optical_depth(z: FloatArray) -> FloatArray:
        ends = np.append(tops[1:], np.inf)
        return np.sum(attenuation * (np.clip(z[..., None], tops, ends) - tops), axis=-1)

    def solid_angle(z: FloatArray) -> FloatArray:
        """Return the solid angle in the water over the aperture's area [1/m^2], for rays along the last axis."""
        radius = height * np.tan(theta) + z * np.tan(phi)
        spread = height / np.cos(theta) ** 2 + z * np.cos(theta) / (index * np.cos(phi) ** 3)
        # sin(theta) over the radius, which both are 0 at nadir.
        return np.asarray(np.cos(theta) * np.tan(theta) / radius / spread / (index**2 * np.cos(phi)))

    depth_end = float(case.get("bottom_depth", np.inf))
    depth = (LIGHT * edges / 2 - height / np.cos(theta)[:, None]) / group * np.cos(phi)[:, None]
    depth = np.clip(depth, 0, depth_end)
    nodes, weights = np.polynomial.legendre.leggauss(DEPTHS)
    found = np.zeros(len(edges) - 1)
    for layer, (top, end) in enumerate(pairwise(np.append(tops, np.inf))):
        scattered = scattering[layer] * backward_phase(case, layer)
        limits = np.clip(depth, top, end)
        for gate in range(len(found)):
            upper, lower = limits[:, gate], limits[:, gate + 1]
            if np.all(lower <= upper):
                continue
            z = upper + (lower - upper) * (1 + nodes[:, None]) / 2
            light = solid_angle(z) * np.exp(-2 * optical_depth(z) / np.cos(phi)) * scattered / np.cos(phi)
            found[gate] += weight @ (weights @ light * (lower - upper) / 2)
    if "bottom_depth" in case:
        z = np.full_like(theta, depth_end)
        loss = np.exp(-2 * optical_depth(z) / np.cos(phi))
        echo = weight * solid_angle(z) * float(case["bottom_reflectance"]) / np.pi * np.cos(phi) * loss
        time = 2 / LIGHT * (height / np.cos(theta) + group * z / np.cos(phi))
        found += np.histogram(time, edges, weights=echo)[0]
    return found


def write(path: Path, case: Case) -> None:
    """Write a case's energies; they have no random error."""
    start, width = float(case["time_start_ns"]), float(case["bin_width_ns"])
    found = energies(case)
    edges = start + width * np.arange(len(found) + 1)
    with path.open("w") as file:
        file.write("gate_start_ns,gate_end_ns,energy_j,stderr_j\n")
        for first, end, energy in zip(edges[:-1], edges[1:], found, strict=True):
            file.write(f"{first:.10g},{end:.10g},{energy:.6e},0\n")


def main() -> None:
    """Write all cases' results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for CASE.csv")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name, case in read_cases().items():
        write(options.output / f"{name}.csv", case)


if __name__ == "__main__":
    main()
