"""Random scenes in which the two integrators are compared, by origin of the light and by gate.

Run by hand: ``python tests/random_scenes.py --count 300 --first 0``. Each scene has a number, from which its parameters
follow. A difference of more than 3.5 standard errors and 2 % is looked at again, with other random numbers and four
times the passes; if more than 4 standard errors and 2 % remain, it is a finding, and its scene is shrunk to the
parameters that cause it: each other one is set back to its default while the difference stays. Few bright paths make
the light that the reference rarely finds, so that its errors from a few passes are too small now and then.

With ``--solids`` scenes have two or three groups of solids that coincide with the bottom, touch, are repeated,
textured, partly open or without effect, and are shrunk by leaving solids out. With ``--shores`` the bottom rises
through the sea in the beam or near it, among up to three rocks.
"""

import mitransient_lidar  # noqa: F401, I001

import argparse
import tempfile
from itertools import pairwise
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.stats import norm, t

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.loading.variants import set_variant

#: Scenes: a flat bottom alone, with a sphere, and with a plate above it.
SCENES = "table1", "fig02_mine", "fig13_2x2"
#: Passes and paths of a pass of both integrators.
SAMPLES = {"lidar_merging": (16, 2**15), "lidar_volpath": (32, 2**16)}
#: The same for scenes with solids, and height of their bottom [m].
SOLID_SAMPLES, FLOOR = {"lidar_merging": (6, 2**15), "lidar_volpath": (12, 2**16)}, -6.0
#: Factor of the passes that confirm a finding, and their first seed.
CONFIRMING, CONFIRMING_SEED = 4, 1000
#: Gates of each origin: parts of its light of the reference.
GATES = 8
#: Least and largest relative standard error of a comparison, beyond rounding, and least share of the light of a scene.
EXACT, KNOWN, FAINT = 1e-4, 0.05, 1e-3
#: Standard errors and relative difference of a finding, and standard errors of what is looked at again.
FINDING, SUSPECT = (4.0, 0.02), 3.5


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
        "phase_function": str(rng.choice(["fournier_forand", "petzold", "hg"])),
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


def solid_scene(parts):
    """Return a scene of 6 m of water, or a shore, with parts."""
    lidar = {"altitude": 100.0, "off_nadir_deg": parts["nadir"], **parts.get("aim", {})}
    reflectance = {"depth": -FLOOR, "bsdf": {"type": "diffuse", "reflectance": parts["bottom"]}}
    return {
        "tx": {"type": "lidar_transmitter", **lidar},
        "rx": {"type": "multipixel_receiver", "layout": "1x1", "film": {"type": "time_gated_film"}, **lidar},
        "bottom": {"type": "seabed", **reflectance, **parts.get("slopes", {})},
        **{name: part for name, part in parts.items() if name not in ("nadir", "bottom", "aim", "slopes")},
    }


def draw_solids(number):
    """Return kinds of solids, joined, and the parts of a scene with them."""
    rng = np.random.default_rng([77, number])
    attenuation, spectrum = rng.uniform(0.1, 0.5), "flat" if rng.random() < 0.4 else "elfouhaily"
    scattering = attenuation * rng.uniform(0.2, 0.7)
    water = {"attenuation": attenuation, "scattering": scattering, "backscattering": 0.03 * scattering}
    solids = RandomSolids(rng)
    if rng.random() < 0.3:
        water |= {"layer_tops": "0, 4", "refractive_index": "1.33, 1.345"}
        solids.add("edge", "rectangle", (*solids.place(), -4.0), 0.4)
    kinds = rng.choice(solids.KINDS, size=rng.integers(2, 4), replace=False)
    for kind in kinds:
        getattr(solids, kind)(str(kind))
    sea = {"type": "ocean_surface", "spectrum": spectrum, "interior": {"type": "layered_water", **water}}
    bottom = solids.texture() if rng.random() < 0.3 else {"type": "spectrum", "value": rng.uniform(0.1, 0.5)}
    return "+".join(kinds), {"nadir": round(rng.uniform(0, 25), 1), "bottom": bottom, "sea": sea, **solids.parts}


def draw_shore(number):
    """Return slope and wind, joined, and the parts of a scene of a shore with rocks."""
    rng = np.random.default_rng([78, number])
    slope, wind = float(np.exp(rng.uniform(np.log(1), np.log(20)))), round(rng.uniform(1, 8), 1)
    attenuation, depth = rng.uniform(0.05, 0.8), rng.uniform(0.1, 1.0)
    scattering = attenuation * rng.uniform(0.2, 0.8)
    water = {"attenuation": attenuation, "scattering": scattering, "backscattering": 0.03 * scattering}
    # The water line is a few beams from the aim, or in the beam.
    away = depth / np.tan(np.radians(slope)) + rng.normal(0, 0.8)
    axis, sign = str(rng.choice(["x", "y"])), int(rng.choice([-1, 1]))
    aim = {"aim_x": 0.0, "aim_y": 0.0, f"aim_{axis}": sign * away}
    solids = RandomSolids(rng)
    for rock in range(int(rng.integers(0, 4))):
        size = solids.size(0.15, 0.6)
        place = (*(solids.place() + np.array([aim["aim_x"], aim["aim_y"]])), rng.uniform(-size, size))
        solids.add(f"rock{rock}", str(rng.choice(["sphere", "cube"])), place, size, solids.turn())
    spectrum = "flat" if rng.random() < 0.3 else "elfouhaily"
    sea = {"type": "ocean_surface", "spectrum": spectrum, "wind_speed": wind, "interior": {"type": "layered_water"}}
    sea["interior"] |= water
    parts = {"nadir": round(rng.uniform(0, 45), 1), "bottom": {"type": "spectrum", "value": rng.uniform(0.1, 0.5)}}
    parts["slopes"] = {"depth": depth, f"slope_{axis}_deg": sign * slope, "size": 200.0}
    name = f"{slope:.1f} deg, {wind:g} m/s {spectrum}, {len(solids.parts)} rocks"
    return name, {**parts, "aim": aim, "sea": sea, **solids.parts}


class RandomSolids:
    """Groups of solids of random places, sizes and reflectances; a method for each kind."""

    KINDS = (
        *("plate_on_bottom", "cube_on_bottom", "flush", "stack", "row", "instances", "instances_on_bottom", "curve"),
        *("veil", "veil_in_air", "grid", "null", "pane", "sphere_on_bottom", "slab", "textured_plate", "bumps"),
    )

    def __init__(self, rng):
        self.rng, self.parts = rng, {}

    def place(self, spread=0.7):
        return self.rng.normal(0, spread, 2).round(2)

    def size(self, low=0.25, high=0.7):
        return round(self.rng.uniform(low, high), 2)

    def texture(self):
        """Return tiles, or a bitmap of 4 x 4 random reflectances."""
        to_uv = mi.ScalarTransform3d().scale([self.size(1, 4)] * 2)
        if self.rng.random() < 0.5:
            return {
                "type": "checkerboard",
                "color0": self.size(0.05, 0.3),
                "color1": self.size(0.3, 0.8),
                "to_uv": to_uv,
            }
        return {**self.bitmap(), "to_uv": to_uv}

    def bitmap(self):
        values = mi.TensorXf(self.rng.uniform(0.05, 0.8, (4, 4, 1)).astype(np.float32))
        return {"type": "bitmap", "data": values, "raw": True}

    def diffuse(self):
        given = self.texture() if self.rng.random() < 0.3 else {"type": "spectrum", "value": self.size(0.1, 0.8)}
        return {"type": "diffuse", "reflectance": given}

    def add(self, name, kind, place, size, turn=0.0, **more):
        to_world = mi.ScalarTransform4f().translate([float(one) for one in place]).rotate([0, 0, 1], turn).scale(size)
        self.parts[name] = {"type": kind, "to_world": to_world, "bsdf": self.diffuse(), **more}

    def turn(self):
        return round(self.rng.uniform(0, 90), 1)

    def plate_on_bottom(self, name):
        self.add(name, str(self.rng.choice(["rectangle", "disk"])), (*self.place(), FLOOR), self.size(), self.turn())

    def cube_on_bottom(self, name):
        size = self.size()
        self.add(name, "cube", (*self.place(), FLOOR + size), size, self.turn())

    def flush(self, name):
        size = self.size()
        self.add(name, "cube", (*self.place(), FLOOR - size), size, self.turn())

    def stack(self, name):
        place, size = self.place(), self.size()
        for level in range(2):
            self.add(f"{name}{level}", "cube", (*place, FLOOR + size * (2 * level + 1)), size)

    def row(self, name):
        (x, y), size = self.place(), self.size()
        for number in range(3):
            self.add(f"{name}{number}", "cube", (x + 2 * size * number, y, -4.0), size)

    def instances(self, name):
        up = mi.ScalarTransform4f().translate([0, 0, 0.8]).scale(0.3)
        members = {
            "ball": {"type": "sphere", "radius": 0.6, "bsdf": self.diffuse()},
            "top": {"type": "cube", "to_world": up, "bsdf": self.diffuse()},
        }
        self._repeat(name, members, [(*self.place(), self.rng.uniform(-5, -2)) for _ in range(3)])

    def instances_on_bottom(self, name):
        x, y = self.place()
        places = [(x + 2 * number - 2, y, FLOOR) for number in range(3)]
        self._repeat(name, {"plate": {"type": "rectangle", "bsdf": self.diffuse()}}, places)

    def _repeat(self, name, members, places):
        self.parts[f"{name}_group"] = {"type": "shapegroup", **members}
        for number, place in enumerate(places):
            self.add(f"{name}{number}", "instance", place, self.size(), self.turn())
            self.parts[f"{name}{number}"].pop("bsdf")
            self.parts[f"{name}{number}"]["group"] = {"type": "ref", "id": f"{name}_group"}

    def curve(self, name):
        x, y = self.place()
        bends = np.arange(8.0)
        points = (x + 0.3 * np.sin(bends), y + 0.3 * np.cos(bends), FLOOR + 0.4 + 0.25 * bends, np.full(8, 0.12))
        path = Path(tempfile.mkdtemp(prefix="random_scenes_")) / "curve.txt"
        np.savetxt(path, np.transpose(points), fmt="%.3f")
        self.add(name, str(self.rng.choice(["linearcurve", "bsplinecurve"])), (0, 0, 0), 1.0, filename=str(path))

    def veil(self, name, height=None, opacity=None):
        height = round(self.rng.uniform(-5, -1), 2) if height is None else height
        opacity = self.size(0.2, 0.8) if opacity is None else opacity
        mask = {"type": "mask", "opacity": opacity, "nested": self.diffuse()}
        self.add(name, "rectangle", (*self.place(), height), self.size() + 0.3, self.turn(), bsdf=mask)

    def veil_in_air(self, name):
        self.veil(name, 1.5)

    def grid(self, name):
        to_uv = mi.ScalarTransform3d().scale([3, 3])
        self.veil(name, -3.3, {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "to_uv": to_uv})

    def null(self, name):
        x, y = self.place()
        for number in range(4):
            self.add(f"{name}{number}", "rectangle", (x, y, -1.1 * (number + 1)), 1.0, bsdf={"type": "null"})

    def pane(self, name):
        glass = {"type": "thindielectric", "int_ior": 1.3401, "ext_ior": 1.34}
        self.add(name, "rectangle", (*self.place(), -2.7), 1.0, bsdf=glass)

    def sphere_on_bottom(self, name):
        size = self.size()
        self.add(name, "sphere", (*self.place(), FLOOR + size), size)

    def slab(self, name):
        size = self.size()
        self.add(name, "cube", (*self.place(), FLOOR + 0.05), [size, size, 0.05])

    def textured_plate(self, name):
        bsdf = {"type": "diffuse", "reflectance": self.texture()}
        self.add(
            name, "rectangle", (*self.place(), round(self.rng.uniform(-5, -2), 2)), self.size(), self.turn(), bsdf=bsdf
        )

    def bumps(self, name):
        bsdf = {"type": "bumpmap", "scale": 0.05, "texture": self.bitmap(), "bsdf": self.diffuse()}
        self.add(name, "rectangle", (*self.place(), -4.5), self.size(), bsdf=bsdf)


def energies(name, params, integrator, confirming):
    """Return energies of passes by origin and bin, shape (passes, origins, bins), over all pixels."""
    passes, paths = SAMPLES[integrator] if name in SCENES else SOLID_SAMPLES[integrator]
    seeds = range(CONFIRMING_SEED, CONFIRMING_SEED + CONFIRMING * passes) if confirming else range(passes)
    session = open_scene(name, dict(params)) if name in SCENES else open_scene(solid_scene(params))
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


def findings(rows, errors=FINDING[0]):
    """Return the rows that differ by more than some standard errors."""
    return [row for row in rows if abs(row[4]) > errors and abs(row[2]) > FINDING[1]]


def shrink(name, params):
    """Return the parameters that a finding needs."""
    for key in list(params):
        fewer = {other: value for other, value in params.items() if other != key}
        try:
            if findings(compare(name, fewer, confirming=True)):
                params = fewer
        except (UserError, KeyError):
            # A part that the scene needs.
            continue
    return params


def summary(compared, found, rows):
    """Return numbers of scenes, findings and comparisons, the distribution of z, and the largest known difference."""
    scores = np.array([row[4] for row in rows])
    rms = float(np.sqrt(np.mean(np.square(scores)))) if rows else np.nan
    beyond = " ".join(f"{np.sum(np.abs(scores) > limit)} beyond {limit}," for limit in (2, 3, 4))
    known = [abs(row[2]) for row in rows if row[3] < 0.5 * FINDING[1]]
    large = f"{sum(one > FINDING[1] for one in known)} of {len(known)} known within 1 % differ by more than 2 %"
    worst = f"the largest by {100 * max(known, default=0):.1f} %"
    counts = f"{compared} scenes, {found} with findings, {len(rows)} comparisons"
    return f"{counts}, {beyond} rms of z {rms:.3f}; {large}, {worst}"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="number of scenes")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--narrow", action="store_true", help="take views of 0.001 to 1 mrad")
    parser.add_argument("--solids", action="store_true", help="take scenes of many solids")
    parser.add_argument("--shores", action="store_true", help="take shores with rocks")
    parser.add_argument("--no-shrink", action="store_true", help="leave findings as they are")
    options = parser.parse_args()
    set_variant()
    all_rows, compared, found = [], 0, 0
    for number in range(options.first, options.first + options.count):
        if options.shores or options.solids:
            name, params = (draw_shore if options.shores else draw_solids)(number)
        else:
            name, params = draw(number, options.narrow)
        try:
            rows = compare(name, params)
        except UserError as error:
            print(f"{number}: refused: {error}", flush=True)
            continue
        compared += 1
        all_rows += rows
        worst = max(rows, key=lambda row: abs(row[4]), default=None)
        print(
            f"{number}: {name}, {len(rows)} comparisons, largest {worst}; {summary(compared, found, all_rows)}",
            flush=True,
        )
        confirmed = findings(compare(name, params, confirming=True)) if findings(rows, SUSPECT) else []
        for row in confirmed:
            print(f"  differs: {row[0]}, gate {row[1]}: {100 * row[2]:+.1f} +- {100 * row[3]:.1f} %, z {row[4]:.1f}")
        if confirmed:
            found += 1
            needed = params if options.no_shrink else shrink(name, params)
            told = (
                " ".join(needed)
                if name not in SCENES
                else " ".join(f"-D {key}={value!r}" for key, value in needed.items())
            )
            print(f"  {name} {told}", flush=True)
    print(summary(compared, found, all_rows))


if __name__ == "__main__":
    main()
