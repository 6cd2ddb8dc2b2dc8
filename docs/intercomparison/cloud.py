"""Draw the case ``cloud`` beside an approximate two-stream model: ``python docs/intercomparison/cloud.py``.

Energies become the full-size cloud's apparent backscatter, E r^2 / (E0 A dr) with the range r. Means over eight 15 m
gates are compared with the two-stream values in every eighth gate, interpolated in the logarithm.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from make_results import HERE, gate_edges, read_cases

from mitransient_lidar.plots import drawing, palette

#: Lengths of the experiment over those of the case, gates of a mean, extinction [1/m], and speed of light [m/ns].
SCALE, GATES, EXTINCTION, LIGHT = 1000.0, 8, 0.04, 0.299792458


def main() -> None:
    """Write the figure and print the ratios."""
    case = read_cases()["cloud"]
    edges = gate_edges(case)
    range_m = SCALE * LIGHT / 2 * edges
    depth = range_m - SCALE * float(case["altitude"])
    middle = 0.5 * (depth[1:] + depth[:-1])
    sent = 1e-3 * float(case["pulse_energy_mj"]) * float(case["aperture_area"])
    two_stream = np.genfromtxt(HERE / "i3rc_two_stream.csv", delimiter=",", skip_header=1).T
    figure = drawing.new_figure(None, 6.4, 6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    upper.plot(EXTINCTION * two_stream[0], two_stream[1], color="k", lw=1, label="two-stream (multiscatter 1.2.10)")
    count = len(middle) // GATES * GATES
    expected = np.exp(np.interp(np.log(middle[4:count]), np.log(two_stream[0]), np.log(two_stream[1])))
    expected = expected[: len(expected) // GATES * GATES].reshape(-1, GATES).mean(axis=1)
    for integrator, mark in zip(("lidar_merging", "lidar_volpath"), palette.marked(2), strict=True):
        with xr.open_dataset(HERE / "results" / integrator / "cloud.nc") as dataset:
            passes = dataset["energy"].values.astype(np.float64)
        apparent = (
            passes * (0.5 * (range_m[1:] + range_m[:-1]) / SCALE) ** 2 / sent / (np.diff(range_m) / SCALE) / SCALE
        )
        # From the fifth gate on: the first value of the two-stream model is that of the fourth.
        means = apparent[:, 4:][:, : len(expected) * GATES].reshape(len(passes), -1, GATES).mean(axis=2)
        mean, error = means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(len(means))
        place = EXTINCTION * middle[4:][: len(expected) * GATES].reshape(-1, GATES).mean(axis=1)
        style = {"linestyle": "", "markersize": 3, "linewidth": 0.8, **mark}
        upper.errorbar(place, mean, error, label=integrator, **style)
        lower.errorbar(place, mean / expected, error / expected, **style)
        for low, high in ((2, 8), (8, 40), (40, 120), (120, 280)):
            inside = (place > low) & (place < high)
            whole = means[:, inside].sum(axis=1) / expected[inside].sum()
            spread = whole.std(ddof=1) / np.sqrt(len(whole))
            print(f"{integrator}, optical depth {low} to {high}: {whole.mean():.3f} +- {spread:.3f}")
    lower.axhline(1, color="k", lw=1)
    upper.set_yscale("log")
    upper.set_ylabel("apparent backscatter (1/(m sr))")
    upper.legend()
    lower.set_ylim(0.8, 1.3)
    lower.set_ylabel("divided by two-stream")
    lower.set_xlabel("optical depth to the apparent range")
    drawing.save(figure, HERE / "cloud.png")


if __name__ == "__main__":
    main()
