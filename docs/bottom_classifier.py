"""Train a classifier on a campaign to find bottom echoes, and hold it against the shipped detector.

``python docs/bottom_classifier.py bottoms.zarr -o bottom_classifier.png``, for the campaign of docs/campaigns.md; needs
scikit-learn. Waveforms without a bottom are the same ones less their bottom's part, recorded with noise of their own.
Both methods are compared on runs that the classifier has never seen, at the same rate of false alarms.
"""

from __future__ import annotations

import argparse
import itertools
import logging
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from sklearn.ensemble import HistGradientBoostingClassifier

import mitransient_lidar  # noqa: F401  (it finds LLVM for Dr.Jit)
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms.echo_detection import has_echo
from mitransient_lidar.analysis.waveforms.echo_table import ECHOES, extract
from mitransient_lidar.campaigns.store import DONE, open_campaign
from mitransient_lidar.campaigns.sweep import render_row

#: Bins on both sides of a place that the classifier sees, and bins between places.
REACH, STEP = 24, 2

#: Scale of small signals, about one step of the digitiser [V].
DIGIT_V = 1e-4

#: Largest error of a depth that counts as found [m].
TOLERANCE_M = 0.5


def main() -> None:
    """Read the arguments, train, compare, and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("bottom_classifier.png"))
    parser.add_argument("--train", type=int, default=5000, help="number of waveforms to train on")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    data = open_campaign(given.store)
    data = data.isel(run=np.flatnonzero(data["status"].values == DONE)).load()
    rng = np.random.default_rng(0)
    order = rng.permutation(data.sizes["run"])
    pixels = data.sizes["pixel"]
    train, rest = np.split(order, [given.train // pixels])
    calibrate, test = np.split(rest, [len(rest) // 3])

    with_bottom = data["signal"].values
    without, shipped_without = without_bottom(given.store, data)
    shipped_with = found_times(data["echo_flags"].values, data["echo_time_ns"].values)
    time = data["time"].values
    bottom_ns = bottom_times(data)
    # A waveform of each pixel of a training run, half of them without a bottom.
    has = rng.random((len(train), pixels)) < 0.5
    signals = np.where(has[..., None], with_bottom[train], without[train])
    places = places_of(time)
    surface_ns = data["surface_time"].values
    features = windows(signals, places, time, surface_ns[train])
    labels = has[..., None] & (np.abs(time[places] - bottom_ns[train][..., None]) < 1.5 * STEP)
    model = HistGradientBoostingClassifier(max_iter=300, learning_rate=0.08, random_state=0)
    model.fit(features.reshape(-1, features.shape[-1]), labels.ravel())

    learned = {
        "with": classifier(model, with_bottom, time, places, surface_ns),
        "without": classifier(model, without, time, places, surface_ns),
    }
    # The rate of false alarms of the shipped detector, and the level of the classifier that has it.
    alarms = np.isfinite(shipped_without[calibrate]).mean()
    level = float(np.quantile(learned["without"][0][calibrate], 1 - alarms))
    per_ns = data["depth_per_ns"].values
    found = {
        "shipped": np.abs(shipped_with - bottom_ns) * per_ns < TOLERANCE_M,
        "learned": (learned["with"][0] > level) & (np.abs(learned["with"][1] - bottom_ns) * per_ns < TOLERANCE_M),
    }
    rates = {
        "shipped": np.isfinite(shipped_without[test]).mean(),
        "learned": (learned["without"][0][test] > level).mean(),
    }
    report(data, train, test, found, rates)
    draw(data, test, found, given.output)


def without_bottom(store: Path, data: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return records of the light of surface and water alone, and when the shipped detector finds a bottom there [ns].

    The shapes are (run, pixel, time) and (run, pixel); times without a bottom are NaN.
    """
    # Lidar and record of all runs.
    template = render_row(store, 0, target_error=None, passes=2)
    light = data["waveform_by_origin"].sel(origin=["surface", "water"]).sum("origin").transpose("run", "pixel", "time")
    signals, times = [], []
    for power, gain, run in zip(light.values.astype(float), data["gain"].values, data["run"].values, strict=True):
        result = template.assign(waveform=(template["waveform"].dims, power[np.newaxis]))
        # Seeds that no run of the campaign has.
        record = detect_waveforms(result, "apd", seed=2**40 + int(run), gain=float(gain))
        echoes = extract(record).isel(shot=0)
        signals.append(record["signal"].values[0])
        times.append(found_times(echoes["flags"].values, echoes["time_ns"].values))
    return np.array(signals), np.array(times)


def found_times(flags: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the times of bottom echoes [ns], NaN without one, from arrays of shape (..., echo)."""
    bottom = ECHOES.index("bottom")
    return np.where(has_echo(flags[..., bottom]), times[..., bottom], np.nan)


def bottom_times(data: xr.Dataset) -> np.ndarray:
    """Return when the echo of the bottom arrives in each pixel [ns], by a level sea, shape (run, pixel)."""
    depth = data["true_bottom_depth"].values[:, None]
    return np.asarray(data["surface_time"].values + depth / data["depth_per_ns"].values)


def places_of(time: np.ndarray) -> np.ndarray:
    """Return the bins that the classifier judges."""
    return np.arange(REACH, len(time) - REACH, STEP)


def windows(signals: np.ndarray, places: np.ndarray, time: np.ndarray, surface_ns: np.ndarray) -> np.ndarray:
    """Return the features of places of signals: the logarithms about each, and its time after the sea.

    The shape is (..., place, feature).
    """
    level = signals[..., :8].mean(axis=-1, keepdims=True)
    scaled = np.arcsinh((signals - level) / DIGIT_V).astype(np.float32)
    around = scaled[..., places[:, None] + np.arange(-REACH, REACH + 1)]
    from_surface = time[places] - surface_ns[..., None]
    return np.concatenate([around, from_surface[..., None].astype(np.float32)], axis=-1)


def classifier(
    model: HistGradientBoostingClassifier,
    signals: np.ndarray,
    time: np.ndarray,
    places: np.ndarray,
    surface_ns: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the highest probability of a bottom in each signal, and its time [ns], shape (run, pixel)."""
    found = []
    for runs in np.array_split(np.arange(len(signals)), 16):
        features = windows(signals[runs], places, time, surface_ns[runs])
        chances = model.predict_proba(features.reshape(-1, features.shape[-1]))[:, 1]
        found.append(chances.reshape(features.shape[:-1]))
    joined = np.concatenate(found)
    return joined.max(axis=-1), time[places[joined.argmax(axis=-1)]]


def report(
    data: xr.Dataset, train: np.ndarray, test: np.ndarray, found: dict[str, np.ndarray], rates: dict[str, float]
) -> None:
    """Print the shares of bottoms found on the runs of the test, by optical depth and by depth."""
    pixels = data.sizes["pixel"]
    print(f"trained on {len(train) * pixels} waveforms, tested on {len(test) * pixels} with and without a bottom")
    print(f"false alarms: shipped {rates['shipped']:.3f}, classifier {rates['learned']:.3f}")
    lengths = (data["attenuation"] * data["bottom_depth"]).values
    table = [("all", np.ones(len(test), dtype=bool))]
    for name, values, edges in (
        ("c z", lengths, (0, 2, 4, 6, 8, 12, 30)),
        ("z (m)", data["bottom_depth"].values, (2, 3, 4, 20)),
    ):
        table += [
            (f"{name} {a:g} to {b:g}", (values[test] >= a) & (values[test] < b)) for a, b in itertools.pairwise(edges)
        ]
    print(f"{'':<14}{'waveforms':>10}{'shipped':>9}{'classifier':>12}{'only shipped':>14}{'only classifier':>17}")
    for name, rows in table:
        a, b = found["shipped"][test][rows], found["learned"][test][rows]
        print(f"{name:<14}{a.size:>10}{a.mean():>9.3f}{b.mean():>12.3f}{(a & ~b).sum():>14}{(b & ~a).sum():>17}")


def draw(data: xr.Dataset, test: np.ndarray, found: dict[str, np.ndarray], path: Path) -> None:
    """Draw the shares of bottoms found against the optical depth of the bottom."""
    lengths = (data["attenuation"] * data["bottom_depth"]).values[test]
    edges = np.quantile(lengths, np.linspace(0, 1, 13))
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    ax = figure.subplots()
    for name, label in (("shipped", "waveforms command"), ("learned", "classifier")):
        shares, errors, middles = [], [], []
        for a, b in itertools.pairwise(edges):
            rows = (lengths >= a) & (lengths <= b)
            each = found[name][test][rows].mean(axis=1)
            shares.append(each.mean())
            errors.append(each.std(ddof=1) / np.sqrt(len(each)))
            middles.append(np.sqrt(a * b))
        ax.errorbar(middles, shares, errors, marker="o", label=label)
    ax.set(xlabel="attenuation x depth of the bottom", ylabel=f"bottoms found to {TOLERANCE_M:g} m", xscale="log")
    ax.legend(frameon=False)
    figure.savefig(path, dpi=160)
    print(path)


if __name__ == "__main__":
    main()
