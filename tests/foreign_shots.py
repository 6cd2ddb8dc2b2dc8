"""Fits of shots that another recorder wrote: scaled, shifted in time, behind the receiver of an instrument.

Run by hand: ``python tests/foreign_shots.py --folder foreign --count 5``. Each instrument has one shot at known
parameters, rendered once with many passes and kept in the folder. Every fit has a record with noise of its own in a CSV
file without errors, whose unit and time zero are unknown, starts that are wrong by a quarter or more, and a model with
random numbers of its own.
"""

import mitransient_lidar  # noqa: I001

import argparse
import csv
import functools
import time
from pathlib import Path

import numpy as np

from mitransient_lidar import results
from mitransient_lidar.studies import fit as study

TRUTH = {"attenuation": 0.4, "bottom_reflectance": 0.1, "bottom_depth": 6.0}
PARAMS = {"spectrum": "flat", "scattering": 0.2}
#: Instruments with the share of their energy that is emitted: noise of the record exceeds that of the render.
INSTRUMENTS = {
    "published_airborne": 0.1,
    "leica_chiroptera4x": 1.0,
    "riegl_vq840g": 1.0,
    "leica_hawkeye4x_deep": 0.1,
    "usgs_eaarl_b": 1.0,
}
#: Bins of shots whose instrument has wider ones than the light needs [ns].
BINS = {"usgs_eaarl_b": 0.1}
#: Passes of the shots behind the records, and passes of a model and their size.
SHOT_PASSES, MODEL_PASSES, PASS_SHARE = 64, 16, 1 / 16


def shot_of(instrument, folder, passes=SHOT_PASSES, **options):
    """Return the shot of an instrument at the truth, rendered unless the folder has it."""
    path = Path(folder) / f"{instrument}.nc"
    if not path.exists():
        bins = {"bin_width_ns": BINS[instrument]} if instrument in BINS else {}
        shot = mitransient_lidar.render(
            "table1", params=PARAMS | TRUTH | bins, instrument=instrument, passes=passes, seed=10**6, **options
        )
        results.save(shot, path)
    shot = results.open(path)
    share = INSTRUMENTS[instrument]
    return shot.assign({name: share * shot[name] for name in ("waveform", "waveform_stderr")})


def write_foreign(shot, instrument, random, path):
    """Write a record of a shot in an unknown unit and with a delay up to 1300 ns; return unit and delay."""
    recorded = mitransient_lidar.record(shot, instrument, gain="auto", seed=int(random.integers(2**31)))
    signal = recorded["signal"].isel(shot=0)
    scale, delay = float(10 ** random.uniform(-2, 4)), float(random.uniform(-300, 1300))
    # In one unit, whatever gains the channels have.
    gain = np.broadcast_to(recorded.attrs["gain"], signal.sizes["pixel"])[:, None]
    counts = scale / (gain / gain[0]) * (signal.transpose("pixel", "time") - signal.isel(time=slice(8)).median("time"))
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["time_ns", *counts["pixel"].values.tolist()])
        for number, when in enumerate(counts["time"].values):
            table.writerow([f"{when + delay:.3f}", *(f"{value:.7g}" for value in counts.values[:, number])])
    return scale, delay


def fit_foreign(instrument, number, folder, passes=MODEL_PASSES, **options):
    """Fit one foreign shot; return the fit, errors over stated errors, and seconds of a core."""
    random = np.random.default_rng(number)
    path = Path(folder) / f"{instrument}_{number}.csv"
    _, delay = write_foreign(shot_of(instrument, folder, **options), instrument, random, path)
    factors = [*random.choice([0.6, 0.75, 1.25, 1.5], 2), random.uniform(0.75, 1.25)]
    start = {name: value * factor for (name, value), factor in zip(TRUTH.items(), factors, strict=True)}
    shot = results.open(Path(folder) / f"{instrument}.nc")
    energy = INSTRUMENTS[instrument] * float(shot.attrs["pulse_energy_mj"])
    began = time.process_time()
    fitted = mitransient_lidar.fit(
        path,
        "table1",
        list(TRUTH),
        params=PARAMS | {"pulse_energy_mj": energy},
        instrument=instrument,
        receiver=instrument,
        start=start,
        passes=passes,
        seed=number + 1,
    )
    seconds = time.process_time() - began
    true = np.array([*TRUTH.values(), delay])
    return fitted, (fitted["value"].values[:4] - true) / fitted["stderr"].values[:4], seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--count", type=int, default=5, help="shots of each instrument")
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    study.render = functools.partial(mitransient_lidar.render, pass_share=PASS_SHARE)
    squares = []
    for number in range(arguments.first, arguments.first + arguments.count):
        for instrument in INSTRUMENTS:
            fitted, z, seconds = fit_foreign(instrument, number, arguments.folder)
            chi = fitted.attrs
            squares.append(z**2)
            print(
                f"{instrument:20} {number:3} z {np.round(z, 2)} chi-squared {chi['chi_squared']:.0f} of "
                f"{chi['expected']:.0f}, converged {chi['converged']}, {chi['renders']} renders, {seconds:.0f} s",
                flush=True,
            )
    print(f"rms z of {', '.join([*TRUTH, 'time'])}: {np.round(np.sqrt(np.mean(squares, axis=0)), 2)}")


if __name__ == "__main__":
    main()
