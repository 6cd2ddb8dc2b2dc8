"""Draw the profile of a flight across a shore: points by class, the true bottom, the water line, and height errors.

``python shore_profile.py shore -o shore.png``, for the flight of ``docs/guide/shore.md``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mitransient_lidar.flights.products import read_points
from mitransient_lidar.plots.palette import CLASSES
from mitransient_lidar.results.attributes import PointClass

#: Marker of each class, so that colour is not all that tells them apart.
MARKERS = {PointClass.GROUND: "^", PointClass.SURFACE: "_", PointClass.BOTTOM: "o", PointClass.NO_ECHO: "x"}


def main() -> None:
    """Read the arguments and the points, draw, and print the place of the water line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flight", type=Path, help="folder of the flight")
    parser.add_argument("-o", "--output", type=Path, default=Path("shore.png"))
    given = parser.parse_args()
    points = read_points(given.flight)
    points = points.isel(point=np.argsort(points["x"].values))
    x, z, truth, kind = (points[name].values for name in ("x", "z", "true_z", "kind"))
    solid = np.isin(kind, [PointClass.GROUND, PointClass.BOTTOM, PointClass.OBJECT, PointClass.UNCLASSIFIED])
    rising = np.flatnonzero(solid)[truth[solid] > 0]
    # The last dip below the sea, landwards of any rock.
    dips = np.flatnonzero(solid & (truth < 0))
    water_line = float(x[rising[x[rising] > x[dips[-1]]][0]])
    print(f"water line at x = {water_line:.1f} m")

    figure = Figure(figsize=(8, 6), layout="constrained")
    profile, errors = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    profile.plot(x[solid], truth[solid], color="black", linewidth=1, label="true height")
    for one, colour in CLASSES.items():
        chosen = kind == one
        if not np.any(chosen):
            continue
        style = {"color": colour, "marker": MARKERS.get(one, "s"), "linestyle": "none", "markersize": 4}
        profile.plot(x[chosen], z[chosen], label=f"{one.text} ({np.count_nonzero(chosen)})", **style)
        if one != PointClass.NO_ECHO:
            stated = points["vertical_uncertainty"].values[chosen]
            errors.errorbar(x[chosen], (z - truth)[chosen], stated, elinewidth=0.5, **style)
    for axes, label in ((profile, "height above the mean sea level (m)"), (errors, "computed minus true (m)")):
        axes.axhline(0, color="0.5", linewidth=0.5)
        axes.axvline(water_line, color="0.3", linestyle="--", linewidth=1)
        axes.set(ylabel=label)
    profile.annotate("water line", (water_line, 1.5), (-4, 0), textcoords="offset points", ha="right")
    profile.legend(loc="lower right")
    errors.set(xlabel="x, towards the land (m)")
    figure.savefig(given.output, dpi=100)


if __name__ == "__main__":
    main()
