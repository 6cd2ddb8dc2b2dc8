"""Random scenes in which the two integrators are compared, by origin of the light and by gate.

Run by hand: ``python tests/random_scenes.py --count 300 --first 0``. Each scene has a number, from which its parameters
follow. A difference of more than 4 standard errors and 2 %, which other random numbers and four times the passes show,
too, is a finding; its scene is shrunk to the parameters that cause it: each other one is set back to its default while
the difference stays. Few bright paths make the light that the reference rarely finds, so that its errors from a few
passes are too small now and then.
"""

import mitransient_lidar  # noqa: F401, I001

import argparse
from itertools import pairwise

import numpy as np
from scipy.stats import norm, t

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.scenes import choose_integrator, open_scene

#: Scenes: a flat bottom alone, with a sphere, and with a plate above it.
SCENES = "table1", "fig02_mine", "fig13_2x2"
#: Passes and paths of a pass of both integrators.
SAMPLES = {"lidar_merging": (16, 2**15), "lidar_volpath": (32, 2**16)}
#: Factor of the passes that confirm a finding, and their first seed.
CONFIRMING, CONFIRMING_SEED = 4, 1000
#: Gates of each origin: parts of its light of the reference.
GATES = 8
#: Least and largest relative standard error of a comparison, beyond rounding, and least share of the light of a scene.
EXACT, KNOWN, FAINT = 1e-4, 0.05, 1e-3
#: Standard errors and relative difference of a finding.
FINDING = 4.0, 0.02


def draw(number, narrow=False):
    """Return name and parameters of a scene, with a view of 0.001 to 1 mrad if it is to be narrow."""
    rng = np.random.default_rng(number)

    def between(low, high, digits=4):
        return float(f"{np.exp(rng.uniform(np.log(low), np.log(high))):.{digits}g}")

    name = str(rng.choice(SCENES))
    depth, attenuation = between(1.0, 15.0), between(0.05, 1.0)
    attenuation = min(attenuation, round(5.0 / depth, 3))
    scattering = round(attenuation * rng.uniform(0.1, 0.9), 4)
    divergence = between(0.1, 20.0)
    view = min(divergence * between(1.0, 30.0), 100.0)
    waves = rng.random() < 0.7
    if narrow:
        view = between(0.001, 1.0)
    params = {
        "altitude": between(10.0, 1000.0),
        "off_nadir_deg": round(rng.uniform(0, 60), 1),
        "divergence_mrad": divergence,
        "field_of_view_mrad": round(view, 7),
        "layout": str(rng.choice(["1x1", "2x2", "1x4"])),
        "spectrum": "elfouhaily" if waves else "flat",
        "wind_speed": round(rng.uniform(2, 10), 1),
        "wind_direction_deg": round(rng.uniform(0, 360)),
        "surface_seed": int(rng.integers(1, 100)),
        "refractive_index": round(rng.uniform(1.32, 1.36), 3),
        "attenuation": attenuation,
        "scattering": scattering,
        "backscattering": round(scattering * between(0.01, 0.05), 6),
        "phase": str(rng.choice(["fournier_forand", "petzold", "hg"])),
        "phase_g": round(rng.uniform(0.5, 0.95), 3),
        "bottom_depth": depth,
        "bottom_reflectance": round(rng.uniform(0.0, 0.5), 2),
    }
    if rng.random() < 0.3:
        factors = [1.0, float(between(0.3, 1.0, 2))]
        params["layer_tops"] = f"0, {round(depth * rng.uniform(0.2, 0.8), 2)}"
        for key in ("attenuation", "scattering", "backscattering"):
            params[key] = ", ".join(f"{params[key] * factor:.6g}" for factor in factors)
    if name != "table1":
        params["target_depth"] = round(depth * rng.uniform(0.4, 0.8), 2)
        params["target_size"] = min(between(0.3, 2.0), round(0.5 * depth, 2))
        params["target_reflectance"] = round(rng.uniform(0.05, 0.8), 2)
    return name, params


def energies(name, params, integrator, confirming):
    """Return energies of passes by origin and bin, shape (passes, origins, bins), over all pixels."""
    passes, paths = SAMPLES[integrator]
    seeds = range(CONFIRMING_SEED, CONFIRMING_SEED + CONFIRMING * passes) if confirming else range(passes)
    session = open_scene(name, dict(params))
    renderer = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor).by_origin()
    found = []
    for seed in seeds:
        energy = renderer.render_pass(seed, paths=paths).histogram.energy()
        found.append(energy.reshape(-1, renderer.classes.count, energy.shape[-1]).sum(axis=0))
    return renderer.classes.names, np.array(found)


def compare(name, params, confirming=False):
    """Return origin, gate, relative difference, its error, and the difference in standard errors, of what is known.

    Gates hold equal parts of an origin's light in the reference; the last one, -1, holds all.
    """
    names, merged = energies(name, params, "lidar_merging", confirming)
    _, reference = energies(name, params, "lidar_volpath", confirming)
    whole, rows = reference.sum(axis=(1, 2)).mean(), []
    for number, origin in enumerate(names):
        light = reference[:, number].mean(axis=0)
        if light.sum() < FAINT * whole:
            continue
        edges = np.searchsorted(np.cumsum(light) / light.sum(), np.arange(1, GATES) / GATES)
        edges = [0, *sorted(set(edges) - {0}), len(light)]
        for gate, (first, end) in enumerate([*pairwise(edges), (0, len(light))]):
            a, b = (samples[:, number, first:end].sum(axis=1) for samples in (merged, reference))
            ea, eb = (samples.std(ddof=1) / len(samples) ** 0.5 for samples in (a, b))
            if not (b.mean() > 0 and EXACT < np.hypot(ea, eb) / b.mean() < KNOWN and min(ea, eb) > 0):
                continue
            # Welch (1947), as a standard normal number.
            freedom = (ea**2 + eb**2) ** 2 / (ea**4 / (len(a) - 1) + eb**4 / (len(b) - 1))
            score = (a.mean() - b.mean()) / np.hypot(ea, eb)
            z = np.copysign(norm.isf(t.sf(abs(score), freedom)), score)
            gate = -1 if (first, end) == (0, len(light)) else gate
            rows.append((origin, gate, a.mean() / b.mean() - 1, np.hypot(ea, eb) / b.mean(), float(z)))
    return rows


def findings(rows):
    """Return the rows that differ."""
    return [row for row in rows if abs(row[4]) > FINDING[0] and abs(row[2]) > FINDING[1]]


def shrink(name, params):
    """Return the parameters that a finding needs."""
    for key in list(params):
        fewer = {other: value for other, value in params.items() if other != key}
        try:
            if findings(compare(name, fewer, confirming=True)):
                params = fewer
        except UserError:
            continue
    return params


def summary(compared, found, scores):
    """Return numbers of scenes, findings and comparisons, and the distribution of z."""
    rms = float(np.sqrt(np.mean(np.square(scores)))) if scores else np.nan
    beyond = " ".join(f"{np.sum(np.abs(scores) > limit)} beyond {limit}," for limit in (2, 3, 4))
    return f"{compared} scenes, {found} with findings, {len(scores)} comparisons, {beyond} rms of z {rms:.3f}"


def main():
    """Compare scenes and print the findings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="number of scenes")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--narrow", action="store_true", help="take views of 0.001 to 1 mrad")
    parser.add_argument("--no-shrink", action="store_true", help="leave findings as they are")
    options = parser.parse_args()
    scores, compared, found = [], 0, 0
    for number in range(options.first, options.first + options.count):
        name, params = draw(number, options.narrow)
        try:
            rows = compare(name, params)
        except UserError as error:
            print(f"{number}: refused: {error}", flush=True)
            continue
        compared += 1
        scores += [row[4] for row in rows]
        worst = max(rows, key=lambda row: abs(row[4]), default=None)
        print(
            f"{number}: {name}, {len(rows)} comparisons, largest {worst}; {summary(compared, found, scores)}",
            flush=True,
        )
        confirmed = findings(compare(name, params, confirming=True)) if findings(rows) else []
        for row in confirmed:
            print(f"  differs: {row[0]}, gate {row[1]}: {100 * row[2]:+.1f} +- {100 * row[3]:.1f} %, z {row[4]:.1f}")
        if confirmed:
            found += 1
            needed = params if options.no_shrink else shrink(name, params)
            print(f"  {name} " + " ".join(f"-D {key}={value!r}" for key, value in needed.items()), flush=True)
    print(summary(compared, found, scores))


if __name__ == "__main__":
    main()
