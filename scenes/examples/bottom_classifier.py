"""Train a classifier on a campaign to find bottom echoes, and hold it against the shipped detector.

``python bottom_classifier.py bottoms.zarr -o bottom_classifier.png``, for the campaign of ``docs/guide/campaigns.md``;
needs scikit-learn. Waveforms without a bottom are the same waveforms minus the bottom light, with noise of their own.
Both methods are compared on runs that the classifier has never seen, at the same false-alarm rate.
"""

from __future__ import annotations

import argparse
import itertools
import logging
from pathlib import Path

import numpy as np
import xarray as xr
from sklearn.ensemble import HistGradientBoostingClassifier

import mitransient_lidar
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms.echo_detection import has_echo
from mitransient_lidar.analysis.waveforms.echo_table import ECHOES, extract
from mitransient_lidar.campaigns.store import DONE
from mitransient_lidar.campaigns.sweep import render_row
from mitransient_lidar.plots import drawing, palette

#: Bins on both sides of a place that the classifier sees, and bins between places.
REACH, STEP = 24, 2

#: Scale of small signals, about one step of the digitiser [V].
DIGIT_V = 1e-4

#: Largest error of a depth that counts as found [m].
TOLERANCE_M = 0.5


_LABELS = {
    "shipped": "command echoes",
    "classifier": "classifier, false-alarm rate at most as echoes",
    "at 1 %": "classifier, false-alarm rate 1 %",
}


def main() -> None:
    """Read the arguments, train, compare, and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("bottom_classifier.png"))
    parser.add_argument("--train", type=int, default=5000, help="number of waveforms to train on")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    data = mitransient_lidar.open(given.store)
    data = data.isel(run=np.flatnonzero(data["status"].values == DONE)).load()
    rng = np.random.default_rng(0)
    order = rng.permutation(data.sizes["run"])
    pixels = data.sizes["pixel"]
    train, rest = np.split(order, [given.train // pixels])

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

    chances, times = classifier(model, with_bottom[rest], time, places, surface_ns[rest])
    false_chances, _ = classifier(model, without[rest], time, places, surface_ns[rest])
    # The first part of the rest gives the level of each rate of false alarms, the other part the test.
    own, here = slice(0, len(rest) // 3), slice(len(rest) // 3, None)
    per_ns = data["depth_per_ns"].values[rest]
    errors_m = {
        name: np.abs(one - bottom_ns[rest]) * per_ns for name, one in (("shipped", shipped_with[rest]), ("", times))
    }
    near = errors_m[""] < TOLERANCE_M
    alarms = {"shipped": np.isfinite(shipped_without[rest])}
    found = {"shipped": errors_m["shipped"] < TOLERANCE_M}
    for name, rate in (("classifier", alarms["shipped"][own].mean()), ("at 1 %", 0.01)):
        level = np.quantile(false_chances[own], 1 - rate)
        found[name], alarms[name], errors_m[name] = (chances > level) & near, false_chances > level, errors_m[""]
    test = data.isel(run=rest[here])
    found = {name: one[here] for name, one in found.items()}
    alarms = {name: one[here] for name, one in alarms.items()}
    errors_m = {name: errors_m[name][here] for name in found}
    print(f"trained on {has.size} waveforms, tested on {test.sizes['run'] * pixels} with and without a bottom")
    report(test, found, alarms, errors_m)
    draw(test, found, given.output)


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
        echoes = extract(record, targets=1).isel(shot=0)
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
    data: xr.Dataset, found: dict[str, np.ndarray], alarms: dict[str, np.ndarray], errors_m: dict[str, np.ndarray]
) -> None:
    """Print the shares of bottoms found by optical depth and depth, the rates of false alarms, and errors of depths."""
    lengths, depths = (data["attenuation"] * data["bottom_depth"]).values, data["bottom_depth"].values
    rows = [("all", np.ones(len(depths), dtype=bool))]
    for name, values, edges in (("c z", lengths, (0, 2, 4, 6, 8, 12, 30)), ("z (m)", depths, (2, 3, 4, 20))):
        rows += [(f"{name} {a:g} to {b:g}", (values >= a) & (values < b)) for a, b in itertools.pairwise(edges)]
    print(f"{'':<16}{'echoes':>10}", *(f"{name:>12}" for name in found), f"{'only shipped':>14}")
    print(f"{'false alarms':<16}{'':>10}", *(f"{one.mean():>12.3f}" for one in alarms.values()))
    medians = [np.median(errors_m[name][one]) for name, one in found.items()]
    print(f"{'median error (m)':<16}{'':>10}", *(f"{one:>12.3f}" for one in medians))
    for name, each in rows:
        shares = [one[each].mean() for one in found.values()]
        only = np.count_nonzero(found["shipped"][each] & ~found["classifier"][each])
        print(f"{name:<16}{found['shipped'][each].size:>10}", *(f"{one:>12.3f}" for one in shares), f"{only:>14}")


def draw(data: xr.Dataset, found: dict[str, np.ndarray], path: Path) -> None:
    """Draw the shares of bottoms found against the optical depth of the bottom."""
    lengths = (data["attenuation"] * data["bottom_depth"]).values
    edges = np.quantile(lengths, np.linspace(0, 1, 13))
    figure = drawing.new_figure(path, 7.0, 4.2)
    ax = figure.subplots()
    for (name, each), mark in zip(found.items(), palette.marked(len(found)), strict=True):
        shares, errors, middles = [], [], []
        for a, b in itertools.pairwise(edges):
            rows = (lengths >= a) & (lengths <= b)
            of_runs = each[rows].mean(axis=1)
            shares.append(of_runs.mean())
            errors.append(of_runs.std(ddof=1) / np.sqrt(len(of_runs)))
            middles.append(np.sqrt(a * b))
        ax.errorbar(middles, shares, errors, markerfacecolor="none", label=_LABELS[name], **mark)
    ax.set(xlabel="attenuation times bottom depth", ylabel=f"share of bottoms found to {TOLERANCE_M:g} m", xscale="log")
    ax.legend(frameon=False)
    drawing.save(figure, path)
    print(path)


if __name__ == "__main__":
    main()
