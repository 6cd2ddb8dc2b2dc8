"""Compare the package with closed forms, exact solutions, published values and measurements.

``python docs/validation/validate.py [CASE ...] -o docs/validation`` computes the cases, by default all. It writes them
into ``cases.csv``, the ``index.md`` table (made where it is missing) and the figures; other cases' rows stay. The
closed forms and scenes are in ``tests``.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

TESTS = Path(__file__).parents[2] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "analytic")]

import conftest  # noqa: E402
import random_scenes  # noqa: E402
import test_beam_spread as beams  # noqa: E402
import test_half_space as half_space  # noqa: E402
import test_passive as daylight_scenes  # noqa: E402
from oracles.beam_average import bottom_energy_per_bin, column_energy_per_bin, surface_energy_per_bin  # noqa: E402
from oracles.half_space import banded_reflectance, phase_moments, water_leaving_reflectance  # noqa: E402

from mitransient_lidar.physics.lidar.level_sea import LidarSystem, fresnel  # noqa: E402
from mitransient_lidar.physics.sea.double_passage import slope_spread, slope_structures  # noqa: E402
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum  # noqa: E402
from mitransient_lidar.physics.water.layers import WaterColumn  # noqa: E402
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters  # noqa: E402
from mitransient_lidar.transport.paths.passes import PathClasses  # noqa: E402

#: Number of random scenes in the table.
RANDOM_SCENES = 6
INTEGRATORS = "lidar_merging", "lidar_volpath"
COLUMNS = "case", "quantity", "unit", "ours", "error", "theirs", "ratio", "z", "source"
BEGIN, END = "<!-- table by validate.py -->", "<!-- end of the table -->"


@dataclass(frozen=True)
class Row:
    """A comparison: our value with its standard error (0 for our closed form), and theirs."""

    quantity: str
    unit: str
    ours: float
    error: float
    theirs: float
    source: str

    def text(self, case: str) -> dict[str, str]:
        """Return the row as text by column; without our error there is no z."""
        z = f"{(self.ours - self.theirs) / self.error:+.1f}" if self.error else ""
        numbers = f"{self.ours:.5g}", f"{self.error:.2g}" if self.error else "", f"{self.theirs:.5g}"
        ratio = f"{self.ours / self.theirs:.4f}"
        return dict(zip(COLUMNS, (case, self.quantity, self.unit, *numbers, ratio, z, self.source), strict=True))


def row(quantity: str, unit: str, samples: FloatArray, theirs: float, source: str) -> Row:
    """Return the row for independent passes, shape (passes,)."""
    samples = np.asarray(samples, dtype=np.float64)
    return Row(quantity, unit, samples.mean(), samples.std(ddof=1) / np.sqrt(len(samples)), float(theirs), source)


def passes(scene: Any, count: int, **options: Any) -> FloatArray:
    """Return independent passes' energies [J], shape (passes, pixels and classes, bins)."""
    renderer = scene.integrator().prepare(scene, scene.sensors()[0], **options)
    return np.array([renderer.render_pass(seed).histogram.energy() for seed in range(count)])


def levels() -> list[Row]:
    """Surface, column and bottom levels by both integrators: 20 degrees, 200 m, 10 mrad beam, 30 mrad view."""
    system = LidarSystem(200.0, np.radians(20.0), 1.34, 1.34, energy=5e-3 * 0.81 * 0.9, aperture_area=0.025)
    sigma, depth, rho, edges = 5e-3, 8.0, 0.1, 1390.0 + np.arange(161)
    seen = lambda x, y: np.hypot(x, y) < 15e-3  # noqa: E731
    column = WaterColumn(*(np.array([value]) for value in (0.0, 0.2, 0.08, 0.0032)))
    back = [float(fournier_forand(np.pi, *fournier_forand_parameters(0.04)))]
    surface = surface_energy_per_bin(edges, system, sigma, (0.003 + 1.92e-3 * 6, 3.16e-3 * 6), seen).sum()
    bottom = bottom_energy_per_bin(edges, system, sigma, column, depth, rho, seen)
    # Light that the bottom reflects may be scattered once, too: the column counts until then.
    end = int(np.flatnonzero(bottom)[0])
    water = column_energy_per_bin(edges, system, sigma, column, back, depth, seen)[:end].sum()
    found = []
    for name in INTEGRATORS:
        integrator = {"type": name, "paths_per_pass": 2**14}
        scene = conftest._build(
            integrator=integrator,
            rx={"layout": "1x1"},
            sea={"slope_variance": "cox_munk", "wind_speed": 6.0, "wind_direction_deg": 90.0},
            water={"attenuation": 50.0, "scattering": 0.0, "backscattering": 0.0},
            bottom=None,
        )
        energy = passes(scene, 8).sum(axis=(1, 2))
        found.append(row(f"surface echo of Gaussian slopes, {name}", "J", energy, surface, "Cox and Munk (1954)"))
        scene = conftest._build(
            integrator=integrator,
            rx={"layout": "1x1"},
            sea={"slope_variance": "2e-5"},
            water={"attenuation": 0.2, "scattering": 0.08, "backscattering": 0.0032},
        )
        # One or several reversals, order of scattering, bins.
        energy = passes(scene, 32, classes=PathClasses(2)).reshape(32, 2, 3, -1)
        scattered, unscattered = energy[:, 0, 1, :end].sum(axis=1), energy[:, 0, 0].sum(axis=1)
        found.append(row(f"column scattered once, {name}", "J", scattered, water, "lidar equation"))
        found.append(row(f"bottom without scattering, {name}", "J", unscattered, bottom.sum(), "lidar equation"))
    return found


def half_spaces() -> list[Row]:
    """Light returned by a half space of isotropic scattering, all orders, over single scattering."""
    walk = {"paths_per_pass": 2**15, "guiding_probability": 0.0, "roulette_threshold": 0.5}
    found = []
    for albedo, degrees, beam in ((0.5, 0.0, 20.0), (0.9, 60.0, 40.0)):
        energy = half_space.returned(conftest._build, passes_of_pixels, 24, degrees, albedo, 0.1, beam, walk)
        once = half_space.single_scattering(degrees, albedo)
        expected = half_space.chandrasekhar_h(np.cos(np.radians(degrees)), albedo) ** 2
        quantity = f"H² of a half space, albedo {albedo:g}, {degrees:g}°, lidar_volpath"
        found.append(row(quantity, "1", energy / once, float(expected), "Chandrasekhar (1960)"))
    return found


def passes_of_pixels(scene: Any, count: int) -> FloatArray:
    """Return the passes' energies, like the tests' fixture."""
    return passes(scene, count)


def slab() -> list[Row]:
    """Light that crosses a slab with optical thickness 2, and light that it reflects."""
    system = partial(beams.parts_of, conftest._build)
    parts = system({**beams.MATCHED, **beams.SLAB}, bottom=21.0, rho=0.0)
    down, up = beams.fluxes(parts, [1e-3, 20.0], 2**16, 16)
    source = "van de Hulst (1980)"
    return [
        row("transmittance of a slab, g 0.75, albedo 0.9, thickness 2", "1", down[:, 1], beams.SLAB_SHARES[0], source),
        row("reflectance of this slab", "1", up[:, 0], beams.SLAB_SHARES[1], source),
    ]


def moments() -> list[Row]:
    """Position of light after 10, 20 and 30 scattering lengths, g 0.924."""
    samples = beams.moments(partial(beams.parts_of, conftest._build), 12)
    expected = beams.exact_moments()
    names = ("mean depth", "m"), ("mean square depth", "m^2"), ("mean square radius", "m^2")
    return [
        row(f"{name} after {10 * (k + 1)} scattering lengths", unit, samples[:, k, m], expected[k, m], "exact moments")
        for k in range(3)
        for m, (name, unit) in enumerate(names)
    ]


def scenes() -> list[Row]:
    """Light by origin, from both integrators in random scenes, with a confirmation's passes."""
    found = []
    for number in range(RANDOM_SCENES):
        for origin, gate, difference, error, _ in random_scenes.compare(*random_scenes.draw(number), confirming=True):
            if gate == -1:
                quantity = f"random scene {number}, {origin}: lidar_merging over lidar_volpath"
                found.append(Row(quantity, "1", 1 + difference, error, 1.0, "lidar_volpath"))
    return found


def glint() -> list[Row]:
    """Radiance of the sun's glint."""
    found = []
    for zenith, azimuth, view, wind, bearing in ((30.0, 180.0, 20.0, 6.0, 0.0), (35.0, 10.0, 30.0, 4.0, 90.0)):
        scene = daylight_scenes.build(
            sun={"zenith_deg": zenith, "azimuth_deg": azimuth},
            sea={"spectrum": "flat", "wind_speed": wind, "wind_direction_deg": bearing},
            rx={"off_nadir_deg": view, "field_of_view_mrad": 0.1},
            depth=0.5,
            rho=0.0,
        )
        expected = daylight_scenes.glint_radiance(zenith, azimuth, view, wind, bearing)
        quantity = f"glint over irradiance, sun {zenith:g}°, view {view:g}°, {wind:g} m/s"
        radiance = daylight_scenes.passes(scene, 8)[:, 0]
        found.append(row(quantity, "1/sr", radiance, expected, "Cox and Munk (1954), eq. 9"))
    return found


#: Remote-sensing reflectance [1/sr] of deep Fournier-Forand water of bb/b 0.0183 under an even sky, by albedo.
REFLECTANCES = {
    **{0.9: 8.1159e-3, 0.8: 3.2858e-3, 0.7: 1.8294e-3, 0.6: 1.1462e-3},
    **{0.5: 7.5220e-4, 0.3: 3.1669e-4, 0.1: 8.1317e-5},
}
#: Edges of the bands of directions of its radiances [deg].
HYDROLIGHT_BANDS = (0, *range(5, 90, 10), 90)
#: The same by a backward Monte Carlo.
MONTE_CARLO = {0.9: 8.049e-3, 0.6: 1.1533e-3}


def daylight() -> list[Row]:
    """Water-leaving radiance at the nadir over the irradiance above a level sea."""
    parameters = fournier_forand_parameters(0.0183)
    moments = phase_moments(lambda angle: fournier_forand(angle, *parameters), 1501)
    found = []
    for albedo, hydrolight in REFLECTANCES.items():
        scene = daylight_scenes.build(
            sky={"irradiance": 1.0},
            water={"attenuation": 1.0, "scattering": albedo, "backscattering": 0.0183 * albedo},
            integrator={"paths_per_pass": 2**18},
        )
        # The sky's mirror image is not random.
        leaving = daylight_scenes.passes(scene, 48)[:, 0] - float(fresnel(0.0, daylight_scenes.N)[0]) / np.pi
        quantity = f"reflectance of deep water, albedo {albedo:g}"
        exact = float(water_leaving_reflectance(albedo, moments[:193], daylight_scenes.N))
        banded = banded_reflectance(albedo, moments, daylight_scenes.N, HYDROLIGHT_BANDS)
        found.append(row(quantity, "1/sr", leaving, exact, "discrete ordinates"))
        found.append(row(quantity, "1/sr", leaving, hydrolight, "HydroLight 4.2"))
        found.append(Row(f"{quantity}, in bands of 10°", "1/sr", banded, 0.0, hydrolight, "HydroLight 4.2"))
        if albedo in MONTE_CARLO:
            found.append(row(quantity, "1/sr", leaving, MONTE_CARLO[albedo], "backward Monte Carlo"))
    return found


#: Depths [m] and coefficients of variation of the downward irradiance at 532 nm, sun 30 to 33 degrees.
FLICKER = {0.86: 0.541, 1.70: 0.377, 2.84: 0.224, 3.78: 0.164, 6.73: 0.078, 9.58: 0.051}
#: Angle of the sun and radius of its disc [rad].
SUN, SUN_RADIUS = np.radians(31.5), 4.65e-3


def flicker() -> list[Row]:
    """Coefficient of variation for unscattered sunlight below Gaussian waves, in closed form.

    The mean square irradiance over the squared mean is the enhancement of light that crosses the sea twice. Its way
    back has the waves of another ray from the sun's disc.
    """
    depth = np.array(list(FLICKER))
    quantiles = (np.arange(12) + 0.5) / 12
    # Distance between the ways of two rays of the disc, with a standard deviation of half of its radius on each axis.
    apart = SUN_RADIUS / np.sqrt(2) / daylight_scenes.N * depth[:, None] * np.sqrt(-2 * np.log(1 - quantiles))
    found = []
    for wind in (3.0, 5.0, 7.0):
        spectrum = ElfouhailySpectrum(wind)
        sea, _ = slope_structures(spectrum, sum(spectrum.slope_variance()), 0.0)
        spread = slope_spread(SUN, daylight_scenes.N) * depth[:, None]
        contrast = np.sqrt(sea.enhancement(spread, apart).mean(axis=1) - 1)
        found += [
            Row(
                f"variation of direct sunlight at {z:g} m, {wind:g} m/s",
                "1",
                ours,
                0.0,
                theirs,
                "Darecki et al. (2011)",
            )
            for (z, theirs), ours in zip(FLICKER.items(), contrast, strict=True)
        ]
    return found


CASES: dict[str, Callable[[], list[Row]]] = {
    "levels": levels,
    "half_space": half_spaces,
    "slab": slab,
    "moments": moments,
    "random_scenes": scenes,
    "glint": glint,
    "daylight": daylight,
    "flicker": flicker,
}


def read(path: Path) -> list[dict[str, str]]:
    """Return a table's rows, none if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def markdown(rows: list[dict[str, str]]) -> str:
    """Return the table of the page."""
    shown = [name for name in COLUMNS if name != "case"]
    lines = [f"| {' | '.join(shown)} |", f"|{'---|' * len(shown)}"]
    return "\n".join(lines + [f"| {' | '.join(row[name] for name in shown)} |" for row in rows])


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """Draw the ratios for rows with errors, and the variation under waves by depth."""
    from mitransient_lidar.plots import drawing, palette

    known = [row for row in rows if row["error"]]
    figure = drawing.new_figure(path / "ratios.png", 9, 1 + 0.24 * len(known))
    ax = figure.subplots()
    ratio = np.array([float(row["ratio"]) for row in known])
    error = np.array([float(row["error"]) / abs(float(row["theirs"])) for row in known])
    ax.axvline(1, color="0.5", lw=1)
    ax.errorbar(ratio, np.arange(len(known)), xerr=error, fmt=".", color=palette.BLUE, capsize=2)
    ax.set_yticks(range(len(known)), [f"{row['quantity']} ({row['source']})" for row in known])
    ax.set_xlabel("computed over expected (1), ±1 s.e.")
    ax.invert_yaxis()
    drawing.save(figure, path / "ratios.png")
    waves = [row for row in rows if row["case"] == "flicker"]
    if waves:
        figure = drawing.new_figure(path / "flicker.png", 6, 4)
        ax = figure.subplots()
        depths = list(FLICKER)
        ours = np.array([float(row["ours"]) for row in waves]).reshape(-1, len(depths))
        for wind, values, style in zip((3, 5, 7), ours, palette.marked(3), strict=True):
            ax.plot(depths, values, ms=4, label=f"direct sunlight, closed form, {wind} m/s", **style)
        ax.plot(depths, list(FLICKER.values()), "k--D", ms=4, label="downward irradiance, measured")
        ax.set(xlabel="depth (m)", ylabel="coefficient of variation", yscale="log")
        ax.legend()
        drawing.save(figure, path / "flicker.png")


def main() -> None:
    """Compute cases and write table, page and figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", nargs="*", help=f"{', '.join(CASES)}; default: all")
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent, help="folder")
    options = parser.parse_args()
    for name in options.case:
        if name not in CASES:
            parser.error(f"case {name!r} must be one of {', '.join(CASES)}")
    options.output.mkdir(parents=True, exist_ok=True)
    rows = read(options.output / "cases.csv")
    for name in options.case or CASES:
        start = time.process_time()
        new = [found.text(name) for found in CASES[name]()]
        rows = sorted(
            [row for row in rows if row["case"] != name] + new, key=lambda row: list(CASES).index(row["case"])
        )
        print(f"{name}: {time.process_time() - start:.0f} s of processor time", flush=True)
        for found in new:
            print(
                "  " + ", ".join(found[key] for key in ("quantity", "ours", "error", "theirs", "ratio", "z")),
                flush=True,
            )
        with (options.output / "cases.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    page = options.output / "index.md"
    text = page.read_text() if page.is_file() else f"# Validation\n\n{BEGIN}\n{END}\n"
    head, rest = text.split(BEGIN)
    page.write_text(f"{head}{BEGIN}\n\n{markdown(rows)}\n\n{END}{rest.split(END)[1]}")
    draw(rows, options.output)


if __name__ == "__main__":
    main()
