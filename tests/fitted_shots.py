"""Fits of recorded shots from starts that are 50 % wrong, against the truth and the Cramer-Rao bounds.

Run by hand: ``python tests/fitted_shots.py --case column --count 25``. Every fit has a record with noise of its own and
a model with random numbers of its own; the starts of all parameters are drawn from half and one and a half times the
truth. The shot behind the records is rendered with many passes, so that its own error matters little.
"""

import mitransient_lidar  # noqa: I001

import argparse
import time

import numpy as np

#: Small scenes: one pixel on a level sea, a short record and a pulse of 0.5 mJ, with the true values of what is fitted.
SMALL = {"layout": "1x1", "spectrum": "flat", "bottom_depth": 6, "pulse_energy_mj": 0.5}
LAYERS = {"layer_tops": "0, 3", "scattering": "0.2, 0.1", "backscattering": "0.01, 0.006"}
CASES = {
    "column": (SMALL, {"attenuation": 0.4, "scattering": 0.13, "bottom_reflectance": 0.1}),
    "layers": (SMALL | LAYERS, {"attenuation[0]": 0.5, "attenuation[1]": 0.3, "bottom_reflectance": 0.1}),
}
#: Passes of the shot behind the records, and renders and passes of the bounds.
SHOT_PASSES, BOUND_RENDERS, BOUND_PASSES = 256, 3, 16
#: Standard errors from the truth within which a fit has ended at the right place.
RIGHT = 5


def true_params(case):
    """Return the parameters of the scene with the true values, those of layers in their list."""
    params, truth = CASES[case]
    joined = {}
    for name, value in truth.items():
        joined.setdefault(name.partition("[")[0], []).append(str(value))
    return {**params, **{name: ", ".join(values) for name, values in joined.items()}}


def run(case, count, receiver, first):
    """Fit `count` records and print what was found, fit by fit and in a table."""
    params, truth = true_params(case), CASES[case][1]
    names, true = list(truth), np.array(list(truth.values()))
    shot = mitransient_lidar.render("table1", params=params, passes=SHOT_PASSES, seed=10**6)
    rows = []
    for number in range(first, first + count):
        record = mitransient_lidar.record(shot, receiver, gain="auto", seed=number)
        factors = np.random.default_rng(number).choice([0.5, 1.5], len(names))
        start = dict(zip(names, (true * factors).tolist(), strict=True))
        began, core = time.perf_counter(), time.process_time()
        fitted = mitransient_lidar.fit(record, "table1", names, params=params, start=start, seed=number + 1)
        taken = time.process_time() - core, time.perf_counter() - began
        error = fitted["value"].values - true
        distance = error @ np.linalg.solve(fitted["covariance"].values, error)
        stderr, by_model = fitted["stderr"].values, fitted["stderr_by_model"].values
        right = bool(fitted.attrs["converged"]) and bool(np.all(np.abs(error) < RIGHT * stderr))
        rows.append((error, stderr, by_model, distance, right, fitted.attrs["renders"], *taken))
        print(
            f"{number:4} from {factors} z {np.round(error / stderr, 2)} distance {distance:5.2f} "
            f"renders {fitted.attrs['renders']} passes {fitted.attrs['passes']} core {taken[0]:.1f} s",
            flush=True,
        )
    errors, stderrs, by_models, distances, rights, renders, cores, seconds = (
        np.array(one) for one in zip(*rows, strict=True)
    )
    gain = record.attrs["gain"]
    known = mitransient_lidar.bounds(
        "table1", params, free=names, receiver=receiver, gain=gain, renders=BOUND_RENDERS, passes=BOUND_PASSES
    )
    bound = known["bound"].values[0]
    rms, stated = (np.sqrt(np.mean(one**2, axis=0)) for one in (errors, stderrs))
    model = np.sqrt(np.mean(by_models**2, axis=0))
    print(f"{case}, {receiver}: {rights.sum()} of {count} fits end within {RIGHT} standard errors of the truth")
    for place, name in enumerate(names):
        print(
            f"  {name:20} bound {100 * bound[place] / true[place]:.3g} %, rms error over bound "
            f"{rms[place] / bound[place]:.2f}, over stated error {rms[place] / stated[place]:.2f}, mean error over "
            f"its own error {np.sqrt(count) * errors[:, place].mean() / errors[:, place].std(ddof=1):.2f}, stated over "
            f"bound {stated[place] / bound[place]:.2f}, of the records alone "
            f"{np.sqrt(stated[place] ** 2 - model[place] ** 2) / bound[place]:.2f}"
        )
    spread = distances.std(ddof=1) / np.sqrt(count)
    print(f"  mean squared distance {distances.mean():.2f} +- {spread:.2f}, expected {len(names)}")
    print(f"  medians: {np.median(renders):g} renders, {np.median(cores):.1f} s of a core, {np.median(seconds):.1f} s")


def main():
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=CASES, default="column")
    parser.add_argument("--count", type=int, default=25)
    parser.add_argument("--first", type=int, default=0, help="number of the first fit, from which its seeds follow")
    parser.add_argument("--receiver", default="apd")
    arguments = parser.parse_args()
    run(arguments.case, arguments.count, arguments.receiver, arguments.first)


if __name__ == "__main__":
    main()
