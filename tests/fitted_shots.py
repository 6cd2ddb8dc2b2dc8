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
SHOT_PASSES, BOUND_RENDERS, BOUND_PASSES = 128, 3, 16
#: Standard errors from the truth within which a fit has ended at the right place.
RIGHT = 5


def true_params(case):
    """Return the parameters of the scene with the true values, those of layers in their list."""
    params, truth = CASES[case]
    joined = {}
    for name, value in truth.items():
        joined.setdefault(name.partition("[")[0], []).append(str(value))
    return {**params, **{name: ", ".join(values) for name, values in joined.items()}}


def fit_one(case, shot, receiver, number):
    """Fit one record and return what was found."""
    params, (_, truth) = true_params(case), CASES[case]
    names, true = list(truth), np.array(list(truth.values()))
    record = mitransient_lidar.record(shot, receiver, gain="auto", seed=number)
    factors = np.random.default_rng(number).choice([0.5, 1.5], len(names))
    start = dict(zip(names, (true * factors).tolist(), strict=True))
    began, core = time.perf_counter(), time.process_time()
    fitted = mitransient_lidar.fit(record, "table1", names, params=params, start=start, seed=number + 1)
    seconds, core = time.perf_counter() - began, time.process_time() - core
    error, stderr = fitted["value"].values - true, fitted["stderr"].values
    print(
        f"{number:4} from {factors} errors over stated {np.round(error / stderr, 2)}, "
        f"{fitted.attrs['renders']} renders, passes {fitted.attrs['passes']}, {core:.1f} s of a core",
        flush=True,
    )
    return {
        "error": error / true,
        "stated": stderr / true,
        "model": fitted["stderr_by_model"].values / true,
        "distance": error @ np.linalg.solve(fitted["covariance"].values, error),
        "right": bool(fitted.attrs["converged"]) and bool(np.all(np.abs(error) < RIGHT * stderr)),
        "renders": fitted.attrs["renders"],
        "core": core,
        "seconds": seconds,
    }


def run(case, count, receiver, first):
    """Fit `count` records and print a table of what was found; a Ctrl-C ends the fits before."""
    params, (_, truth) = true_params(case), CASES[case]
    names, true = list(truth), np.array(list(truth.values()))
    shot = mitransient_lidar.render("table1", params=params, passes=SHOT_PASSES, seed=10**6)
    gain = mitransient_lidar.record(shot, receiver, gain="auto", seed=first).attrs["gain"]
    options = {"receiver": receiver, "gain": gain, "renders": BOUND_RENDERS, "passes": BOUND_PASSES}
    bound = mitransient_lidar.bounds("table1", params, free=names, **options)["bound"].values[0] / true
    rows = []
    try:
        for number in range(first, first + count):
            rows.append(fit_one(case, shot, receiver, number))
    except KeyboardInterrupt:
        print("interrupted")
    found = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    print(f"{case}, {receiver}: {found['right'].sum()} of {len(rows)} end within {RIGHT} standard errors of the truth")
    error, stated, model = (np.sqrt(np.mean(found[name] ** 2, axis=0)) for name in ("error", "stated", "model"))
    shares = {"bound": 100 * bound, "stated by the record alone / bound": np.sqrt(stated**2 - model**2) / bound}
    shares |= {"stated / bound": stated / bound, "error / bound": error / bound, "error / stated": error / stated}
    for place, name in enumerate(names):
        print(f"  {name:20} " + ", ".join(f"{label} {value[place]:.3g}" for label, value in shares.items()))
    spread = found["distance"].std(ddof=1) / np.sqrt(len(rows))
    print(f"  mean squared distance {found['distance'].mean():.2f} +- {spread:.2f}, expected {len(names)}")
    medians = {name: np.median(found[name]) for name in ("renders", "core", "seconds")}
    print("  medians: {renders:g} renders, {core:.1f} s of a core, {seconds:.1f} s".format(**medians))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=CASES, default="column")
    parser.add_argument("--count", type=int, default=25)
    parser.add_argument("--first", type=int, default=0, help="number of the first fit, from which its seeds follow")
    parser.add_argument("--receiver", default="apd")
    arguments = parser.parse_args()
    run(arguments.case, arguments.count, arguments.receiver, arguments.first)


if __name__ == "__main__":
    main()
