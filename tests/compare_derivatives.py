"""Derivatives from paths against central differences on common random numbers, in the bins of all pixels.

Run by hand: ``python tests/compare_derivatives.py --case turbid --integrator lidar_merging``. A pass renders the scene
with the derivatives by all parameters of which paths have sums, and, with the same random numbers, at four values
beside that of each parameter, from which a difference of fourth order follows: its bias is below the standard errors.
The mean over the passes of derivative less difference is compared with its own standard error. Bins are those in which
the passes know the energy to 5 %, so that their means are near normal.
"""

import mitransient_lidar  # noqa: F401, I001

import argparse
import time
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.stats import norm, t

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.parameters import parameter_of, with_value
from mitransient_lidar.rendering.derivatives import RIPPLES, known_names, path_parameters
from mitransient_lidar.rendering.passes import pass_seed
from mitransient_lidar.loading.scenes import choose_integrator, open_scene

#: Parts of scenes: one pixel on a sea without waves, whose ripples have a variance that is known, and their focusing,
#: of which there is no derivative by this variance, left out.
LEVEL = {"layout": "1x1", "spectrum": "flat", "slope_variance": 0.02, "ripple_focusing": "false", "bin_width_ns": 2}
WAVES = {"wind_speed": 6, "bin_width_ns": 2}
#: Scenes, their parameters, and the parameters of derivatives by case; by default all of which paths have sums.
CASES = {
    "clear": ("table1", {**LEVEL, "attenuation": 0.12, "scattering": 0.05, "backscattering": 0.001}),
    "layered": ("fig15_2x2", {**LEVEL, "layout": "2x2", "bottom_depth": 6}),
    "turbid": ("table1", {**LEVEL, "attenuation": 1.5, "scattering": 1.2, "backscattering": 0.03, "bottom_depth": 4}),
    "absorbing": ("table1", {**LEVEL, "attenuation": 1.0, "scattering": 0.2, "bottom_depth": 4}),
    "hg": ("table1", {**LEVEL, "phase_function": "hg", "phase_g": 0.9, "backscattering": 0}),
    "waves": ("table1", WAVES, ["attenuation", "scattering", "backscattering", "bottom_reflectance"]),
    "ripples": ("table1", {**WAVES, "ripple_focusing": "false"}, ["divergence_mrad", "ripple_variance"]),
    "skewed": (
        "table1",
        {**WAVES, "slope_distribution": "gram_charlier", "ripple_focusing": "false"},
        ["ripple_variance"],
    ),
    "target": ("fig13_2x2", {**LEVEL, "layout": "2x2", "bottom_depth": 9, "target_depth": 5}),
    "narrow": ("table1", {**LEVEL, "divergence_mrad": 0.5, "field_of_view_mrad": 10}),
    "imager": ("table1", {**LEVEL, "layout": "16x16", "bin_width_ns": 5}),
    "under water": (
        "table1",
        {**LEVEL, "altitude": -1, "bottom_depth": 6},
        ["attenuation", "scattering", "backscattering", "divergence_mrad", "bottom_reflectance"],
    ),
}
#: Passes, and paths of a pass, of both integrators.
SAMPLES = {"lidar_merging": (12, 2**13), "lidar_volpath": (16, 2**16)}
#: Smaller one of two steps over the value, by parameter; those of all reflectances are alike.
STEPS = {"attenuation": 0.004, "scattering": 0.04, "backscattering": 0.1, "phase_g": 0.05, "divergence_mrad": 0.05}
STEPS |= {"ripple_variance": 0.05, "reflectance": 0.2}
#: Longer ones where the difference is noisy: free flights follow from the attenuation, and other cells from the beam.
LONG_STEPS = {("lidar_volpath", "attenuation"): 0.04, ("lidar_merging", "divergence_mrad"): 0.1}
#: Places of renders, in steps, and their weights in a difference of fourth order.
FOURTH_ORDER = ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))
#: Largest relative standard error of the energy of a bin. Bins with larger ones lack bright paths where they seem to be
#: known: up to 10 %, the derivatives of 256 pixels by the reference were 4 % too small, as are the energies.
KNOWN = 0.05
#: Relative error of differences by their steps, which shows where all renders have the same paths: 0.09 % by the
#: variance of ripples, where few facets return light.
TOLERANCE = 1e-3


def step_of(name, value, integrator):
    """Return the smaller step of a parameter: of a mean cosine it is relative to what it lacks to 1."""
    known = parameter_of(name)
    end = "reflectance" if known.endswith("reflectance") else known
    relative = LONG_STEPS.get((integrator, end), STEPS[end])
    return relative * (1 - value if known == "phase_g" else value)


@dataclass(frozen=True)
class Samples:
    """Energy [J] of the bins of each pass, shape (passes, pixels, bins), and derivatives by parameter and difference.

    `scores` and `differences` [J per unit of the parameter] are those from paths and from differences, shape
    (passes, parameters, pixels, bins).
    """

    names: list[str]
    values: np.ndarray
    energy: np.ndarray
    scores: np.ndarray
    differences: np.ndarray


def sample(case, integrator, passes, paths, seed=0, only=None):
    """Render passes of a case and return their `Samples`, by default of all parameters."""
    scene, params, *some = CASES[case]
    session = open_scene(scene, dict(params))
    given = {"photons_per_pass": paths} if integrator == "lidar_merging" else {}
    chosen = choose_integrator(session.scene, {"type": integrator, "paths_per_pass": paths, **given})
    base = chosen.prepare(session.scene, session.sensor)
    names = only or (some[0] if some else known_names(base.scene))
    parameters = [one for name in names for one in _parameter(base, name)]
    perturbed = base.perturbed([one.perturbation for one in parameters])
    beside = []
    for one in parameters:
        step = step_of(one.name, one.value, integrator)
        beside.append([(_moved(session, chosen, base, one, k * step), w / step) for k, w in FOURTH_ORDER])
    shape = (base.scene.receiver.pixels.count, -1)
    rows = []
    for number in range(passes):
        own = pass_seed(seed, number)
        record = perturbed.render_pass(own).histogram
        slopes = [
            sum(weight * renderer.render_pass(own).histogram.energy() for renderer, weight in renderers)
            for renderers in beside
        ]
        scores = [change.reshape(shape) for change in record.perturbed()]
        rows.append((record.energy().reshape(shape), scores, [slope.reshape(shape) for slope in slopes]))
    energy, scores, differences = (np.array(values) for values in zip(*rows, strict=True))
    values = np.array([one.value for one in parameters])
    return Samples([one.name for one in parameters], values, energy, scores, differences)


def _parameter(base, name):
    """Return the parameter of a name; none if the light does not depend on it."""
    try:
        return path_parameters(base, [name])
    except UserError:
        return []


def _moved(session, integrator, base, parameter, step):
    """Return the renderer of a scene with another value of a parameter, with bins, points and cells of the base."""
    name, value = parameter.name, parameter.value + step
    if name == RIPPLES:
        moved = open_scene(session.source)
        _scale_ripples(moved.scene, value / parameter.value)
    else:
        known = parameter_of(name)
        params = {known: with_value(session.parameters, name, value)[known]}
        moved = open_scene(session.source, params, model=session.scene)
    return integrator.prepare(moved.scene, moved.sensor, layout_of=base)


def _scale_ripples(scene, factor):
    """Multiply the slope variances of the ripples, which are no parameter of a scene."""
    sea = next(shape for shape in scene.shapes() if shape.id() == "surface")
    variances = tuple(factor * variance for variance in sea.sea.ripple_variance)
    if sea.sea.slope_series is not None:
        sea.bsdf().set_slopes(variances, sea.sea.slope_series)
        return
    buffers = mi.traverse(sea)
    for axis, variance in zip("uv", variances, strict=True):
        buffers[f"bsdf.alpha_{axis}.value"] = float(np.sqrt(2 * variance))
    buffers.update()


def compare(samples):
    """Return by parameter the differences in standard errors, as normal numbers, and the pooled ratio with its error.

    The ratio, difference over derivative, is that of sums over bins, weighted by the derivative, from the passes of
    other parity, whose noise is independent, over the variance of the energy, known better than that of differences.
    """
    passes = len(samples.energy)
    mean, error = samples.energy.mean(axis=0), samples.energy.std(axis=0, ddof=1) / np.sqrt(passes)
    known = (mean > 0) & (error < KNOWN * mean)
    rows = {}
    for number, name in enumerate(samples.names):
        score, slope = (values[:, number][:, known] for values in (samples.scores, samples.differences))
        lit = (score != 0).any(axis=0) | (slope != 0).any(axis=0)
        if not lit.any():
            continue
        score, slope = score[:, lit], slope[:, lit]
        excess = (score - slope).mean(axis=0)
        excess -= np.clip(excess, *(sign * TOLERANCE * np.abs(slope.mean(axis=0)) for sign in (-1, 1)))
        own = (score - slope).std(axis=0, ddof=1) / np.sqrt(passes)
        far = excess / own
        z = np.copysign(norm.isf(t.sf(np.abs(far), passes - 1)), far)
        rows[name] = z, *_ratio(score, slope, error[known][lit])
    return rows


def _ratio(score, slope, error):
    """Return the ratio of sums over bins and its standard error; `error` is that of the energy."""
    even = np.arange(len(slope)) % 2 == 0
    weights = np.where(even[:, None], score[1::2].mean(axis=0), score[::2].mean(axis=0)) / error**2
    a, b = (weights * score).sum(axis=1), (weights * slope).sum(axis=1)
    ratio = b.mean() / a.mean()
    return ratio, (b - ratio * a).std(ddof=1) / np.sqrt(len(a)) / abs(a.mean())


def describe(z):
    beyond = " ".join(f"{100 * np.mean(np.abs(z) > limit):5.1f}" for limit in (2, 3))
    return f"{z.size:5} {np.sqrt(np.mean(z**2)):5.2f} {beyond} {np.abs(z).max():5.1f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=CASES, action="append", help="by default all")
    parser.add_argument("--integrator", choices=SAMPLES, action="append", help="by default both")
    parser.add_argument("--parameter", action="append", help="by default all of which paths have sums")
    parser.add_argument("--passes", type=int, default=1, help="factor of the passes")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("case, integrator, parameter: bins, rms of z, % beyond 2 and 3, largest |z|, difference over derivative")
    scores = []
    for case in options.case or CASES:
        for integrator in options.integrator or SAMPLES:
            began = time.perf_counter()
            passes, paths = SAMPLES[integrator]
            samples = sample(case, integrator, options.passes * passes, paths, options.seed, options.parameter)
            rows = compare(samples)
            for name, (z, ratio, error) in rows.items():
                print(f"{case:12} {integrator:14} {name:20} {describe(z)}   {ratio:.4f} +- {error:.4f}")
            together = np.concatenate([z for z, _, _ in rows.values()])
            scores.append(together)
            seconds = time.perf_counter() - began
            print(f"{case:12} {integrator:14} {'all':20} {describe(together)}   {seconds:.0f} s", flush=True)
    print(f"{'all':48} {describe(np.concatenate(scores))}")


if __name__ == "__main__":
    main()
