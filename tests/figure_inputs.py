"""Small inputs of every kind of figure, and the figures of them: no two rows, columns, pixels or values are alike."""

import json

import numpy as np
import xarray as xr
from closed_form_waveform import TRUTH, closed_form, noisy

from mitransient_lidar import results
from mitransient_lidar.analysis.comparison import compare
from mitransient_lidar.analysis.information.fits import WaveformFit
from mitransient_lidar.analysis.information.measured import measured
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.water.profiles import Profile
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.plots.campaigns import plot_campaign
from mitransient_lidar.plots.gates.echoes import plot_depths
from mitransient_lidar.plots.gates.images import plot_gates, plot_passive
from mitransient_lidar.plots.layout import plot_layout
from mitransient_lidar.plots.studies.depths import plot_depth_bias, plot_forecast, plot_orders, plot_uncertainty
from mitransient_lidar.plots.studies.light import plot_fov_sweep, plot_scattering_orders
from mitransient_lidar.plots.studies.parameters import plot_fit
from mitransient_lidar.plots.studies.shots import plot_found_shots, plot_shot_statistics
from mitransient_lidar.plots.studies.targets import plot_target_map, plot_target_signal
from mitransient_lidar.plots.water import plot_phase_function, plot_profile
from mitransient_lidar.plots.waveforms import plot_comparison, plot_derivatives, plot_waveforms
from mitransient_lidar.rendering.shots.truth import SeaMap, Shot
from mitransient_lidar.studies.shots import RenderedShots
from mitransient_lidar.studies.water_report import fournier_forand_of

PIXELS = ["red", "green", "blue", "black"]
LIDAR = {"altitude": 200.0, "off_nadir_deg": 20.0, "refractive_index": 1.34, "group_index": 1.364}
LIDAR |= {"scene": "fig09", "surface_time_ns": 1420.0, "window_start_ns": 1412.0, "window_end_ns": 1508.0}
LIDAR |= {"layout": "2x2", "field_of_view_mrad": 30.0, "field_of_view_shape": "circle", "error_median": 0.0098}


def random(seed):
    return np.random.default_rng(seed)


def result(pixels=4, grid=None, scale=1.0, **attributes):
    """Return a result of a surface and a bottom echo, stronger in every next pixel."""
    time = 1405.25 + 0.5 * np.arange(300)
    echo = 2e-5 * np.exp(-((time - 1420) ** 2) / 9) + 1e-6 * np.exp(-((time - 1495) ** 2) / 9) + 1e-9
    power = scale * echo * (1 + np.arange(pixels))[:, np.newaxis]
    centres = [(6.4, 6.4), (6.4, -6.4), (-6.4, 6.4), (-6.4, -6.4)][:pixels]
    if grid is not None:
        centres = [(5.0 - 10 * row, 10.0 - 10 * column) for row in range(grid[0]) for column in range(grid[1])]
    return results.build(
        *(0.5e-9 * power, 0.005e-9 * power, power, 0.01 * power),
        time=TimeAxis(1405.0, 0.5, 300),
        pixel_names=PIXELS[:pixels] if grid is None else [],
        pixel_centres_mrad=centres,
        grid=grid,
        attributes={**LIDAR, **attributes},
    )


def series(*scales, **options):
    """Return shots of different strengths."""
    shots = [result(scale=scale, **options) for scale in scales]
    return xr.concat(shots, "shot", combine_attrs="override").assign_coords(shot=np.arange(len(shots)))


def stack(echoes_at=None, pixels=False, gates=12):
    """Return gates of 5 ns, the first one 5 ns before the surface echo; or echoes of depths above a column."""
    start = 1420.0 + (5.0 * (np.arange(gates) - 1) if echoes_at is None else np.arange(gates) - 5.0)
    depth = 0.1 * (start + 2.5 - 1420.0)
    dims, shape = (("pixel",), (3,)) if pixels else (("row", "column"), (4, 5))
    if echoes_at is None:
        energy = 1e-15 * (1 + np.arange(gates)) * (1 + 0.1 * np.arange(np.prod(shape))).reshape(*shape, 1)
    else:
        echo = np.exp(-((depth - echoes_at[..., np.newaxis]) ** 2) / 0.125)
        energy = 1e-15 * (echo + 0.2 * np.exp(-0.2 * depth) + 100 * np.exp(-(depth**2) / 0.125))
    angle_x, angle_y = np.meshgrid(6.0 - 4.0 * np.arange(4), 3.0 * (2 - np.arange(5)), indexing="ij")
    coords = {
        **{"gate": np.arange(gates), "gate_start": ("gate", start), "gate_depth": ("gate", depth)},
        "gate_width": ("gate", np.full(gates, 5.0)),
        "angle_x": (dims, angle_x[:3, 0] if pixels else angle_x),
        "angle_y": (dims, angle_y[:3, 0] if pixels else angle_y),
        **({"pixel": ["near", "middle", "far"]} if pixels else {}),
    }
    data = {"gate_energy": ((*dims, "gate"), energy), "gate_energy_stderr": ((*dims, "gate"), 0 * energy + 1e-17)}
    return xr.Dataset(
        data, coords, {"scene": "sand.xml", "surface_time_ns": 1420.0, "pulse_fwhm_ns": 5.0, "pulses": 20}
    )


def campaign():
    """Return a campaign whose bottoms are found where the attenuation is below 0.5; one run failed."""
    rng, runs = random(1), 60
    attenuation, depth = np.exp(rng.uniform(np.log(0.1), np.log(2), runs)), rng.uniform(2, 20, runs)
    flags = np.ones((runs, 2, 4), dtype=np.int16)
    flags[attenuation < 0.5, :, 3] = 0
    inputs = {"attenuation": attenuation, "bottom_depth": depth, "wind_speed": rng.choice([3.0, 6.0, 10.0], runs)}
    inputs["petzold"] = rng.choice(["clear", "turbid"], runs)
    data = {
        "waveform": (("run", "pixel", "time"), rng.random((runs, 2, 50)).astype(np.float32)),
        "echo_flags": (("run", "pixel", "echo"), flags),
        "status": ("run", np.where(np.arange(runs) == 7, 2, 1)),
        "error_median": ("run", np.full(runs, 0.05)),
    }
    # Below its range a waveform is not drawn as if it were a signal.
    data["waveform"][1][..., 10:20] = 0
    labels = {"time": np.arange(1000, 1050.0), "echo": ["surface", "column", "target", "bottom"]}
    units = {"attenuation": "1/m", "bottom_depth": "m", "wind_speed": "m/s", "petzold": "1"}
    coords = (
        {name: ("run", values, {"units": units[name]}) for name, values in inputs.items()}
        | labels
        | {"run": np.arange(runs)}
    )
    return xr.Dataset(data, coords, {"title": "Campaign of 60 runs", "inputs": {name: name for name in inputs}})


def uncertainty():
    """Return uncertainties that differ in every cell; the bottom of the last water is lost at the larger depth."""
    dims, shape = ("correction", "wind_speed", "water", "depth"), (2, 2, 4, 2)
    cells = np.arange(32).reshape(shape)
    tvu, order = 0.1 + 0.005 * cells, cells % 5
    tvu[:, :, -1, -1], order[:, :, -1, -1] = np.nan, -1
    coords = {"correction": ["none", "table"], "wind_speed": [1.0, 5.0], "water": ["III", "3C", "7C", "9C"]}
    coords |= {"depth": [2.0, 6.0], "altitude": 300.0, "off_nadir_deg": 20.0}
    data = {"tvu": (dims, tvu), "order": (dims, order), "found": (dims[1:], np.ones(shape[1:]))}
    return xr.Dataset(data, coords, {"instrument": "made"})


def depth_bias():
    """Return biases of two estimators at three angles."""
    dims = ("off_nadir_deg", "wind_speed", "water", "depth", "estimator", "pixel")
    bias = np.linspace(-0.2, 0.1, 12).reshape(3, 1, 1, 2, 2, 1)
    coords = {"off_nadir_deg": [0.0, 20.0, 40.0], "wind_speed": [0.0], "water": ["1C"], "depth": [2.0, 6.0]}
    coords |= {"ripples": ("wind_speed", [6.0]), "estimator": ["leading_edge", "peak"], "pixel": ["single"]}
    data = {"bias": (dims, bias), "spread": (dims, np.full(bias.shape, 0.01))}
    return xr.Dataset(data, coords, {"instrument": "made", "receiver": "ideal"})


def found_shots(waveforms=True):
    """Return two shots over a sea with crests along y, and a receiver whose far half is pixel 0."""
    lines, grid = np.arange(-20, 20, 0.5), np.linspace(-2, 2, 41)
    heights = np.broadcast_to(np.sin(2 * np.pi * lines / 10), (80, 80))
    sea = SeaMap(lines, lines, heights, np.zeros((80, 80)), np.zeros((80, 80)))
    shots = (Shot("towards", 1.0, 2.0, 0.1, 0.0), Shot("level", -4.0, 0.0, 0.0, -0.05))
    x, y = np.meshgrid(grid, grid)
    pixel_map = np.where(np.hypot(x, y) < 1.5, np.where(x > 0, 0, 1), -1)
    echo = 1e-3 * np.exp(-((np.arange(60) - 20) ** 2) / 8)
    window = {"window_start_ns": 1418.0, "window_end_ns": 1440.0, "bin_width_ns": 1.0}
    shown = [
        xr.Dataset({"waveform": (("pixel", "time"), np.outer([1, 2], factor * echo))}, {"time": 1400.0 + np.arange(60)})
        for factor in (1, 3)
    ]
    shown = [one.assign_attrs(window) for one in shown]
    return RenderedShots("made", shots, shown if waveforms else [], sea, 0.5, (1.2, 1.0), grid, pixel_map, 2)


def fitted():
    data = noisy(0.002, random(1), pixels=("a", "b"))
    return WaveformFit(measured(data), lambda values: closed_form(values, pixels=("a", "b")), TRUTH).run()


def forecast(is_map):
    """Return a forecast of a slope with a strip of land and a hole, or of a range of depths."""
    dims, depth = ("y", "x"), np.tile(np.linspace(-1.0, 8.0, 10), (4, 1))
    coords = {"y": np.arange(4.0), "x": np.arange(10.0)}
    depth[0, 5] = np.nan
    if not is_map:
        dims, depth = ("depth",), np.linspace(1.0, 8.0, 20)
        coords = {"depth": depth}
    found = np.where(depth >= 0.5, np.clip(3 - depth / 2.5, 0, 1), np.nan)
    tvu = np.where(found >= 0.5, 0.15 + 0.02 * depth, np.nan)
    order = np.where(np.isfinite(found), np.where(np.isfinite(tvu), 1.0, -1.0), np.nan)
    maps = {"found": found, "tvu": tvu, "order": order, "deepest": np.where(np.isfinite(found), 6.25, np.nan)}
    data = {name: (dims, values) for name, values in maps.items()}
    data |= {"table_depth": (("water", "node"), [[1.0, 6.0]]), "table_found": (("water", "node"), [[1.0, 0.6]])}
    data |= {"depth": (dims, depth)} if is_map else {}
    attributes = {"instrument": "made", "altitude": 200.0, "off_nadir_deg": 20.0, "wind_speed": 5.0, "water": "kd 0.2"}
    return xr.Dataset(data, coords, attributes)


def fov_sweep():
    """Return attenuations in three fields of view, 200 m from the surface."""
    fields = np.array([2.0, 10.0, 50.0])
    data = {"effective_attenuation": [0.28, 0.22, 0.18], "effective_attenuation_stderr": [0.005] * 3}
    data["scaled_radius"] = 0.03 * fields
    attributes = {"scene": "made", "attenuation": 0.3, "kd": 0.17, "a_plus_bb": 0.156, "absorption": 0.15}
    attributes |= {"beam_radius": 1.0, "min_depth": 1.0, "max_depth": 5.0}
    named = {name: ("field_of_view", values) for name, values in data.items()}
    return xr.Dataset(named, {"field_of_view": fields}, attributes)


def orders():
    """Return light of three orders, turned once and more often."""
    power = random(2).uniform(1e-7, 1e-6, (4, 2, 3, 50))
    power[..., 40:] = 0
    coords = {"reversals": ["one", "several"], "order": np.arange(3), "time": 1400.0 + np.arange(50)}
    return xr.Dataset({"waveform": (("pixel", "reversals", "order", "time"), power)}, coords, {"scene": "made"})


def shot_statistics():
    """Return echoes that depend on the slopes alone: separation, strength and depth along, red and green across."""
    along, across = random(3).normal(0, 0.05, (2, 40))
    separation, sideways = -20 * along, 8 * across
    surface = 1420 + np.stack([separation - sideways / 2, separation + sideways / 2, 0 * along, 0 * along], axis=1)
    bottom = 1467 + np.repeat((28 * along)[:, np.newaxis], 4, axis=1)
    bottom[7, 2] = np.nan
    over = ("shot", "pixel")
    data = {"surface_time": (over, surface), "bottom_time": (over, bottom)}
    data["surface_peak"] = (over, np.repeat(0.25 * 10 ** (-4 + 5 * along)[:, np.newaxis], 4, axis=1))
    data |= {"slope_along": ("shot", along), "slope_across": ("shot", across)}
    return xr.Dataset(data, {"pixel": PIXELS}, {**LIDAR, "scene.bottom_depth": "5"})


def target_signal():
    """Return the light of four pixels with and without a target."""
    time = 1400 + np.arange(100.0)
    background = 1e-6 * np.exp(-np.arange(100) / 20) * np.arange(1, 5)[:, np.newaxis]
    signal = 1e-7 * np.exp(-(((time - 1450) / 4) ** 2)) * np.arange(1, 5)[:, np.newaxis]
    data = {"waveform": background + signal, "background": background, "difference": signal}
    data["difference_stderr"] = 0.1 * signal
    named = {name: (("pixel", "time"), values) for name, values in data.items()}
    named["combined_detectability"] = ("combination", [2.0, 3.0])
    attributes = {"scene": "made", "gate_start_ns": 1440.0, "gate_end_ns": 1460.0}
    return xr.Dataset(named, {"pixel": PIXELS, "time": time}, attributes)


def target_map():
    """Return echoes of a target at 3 x 2 places."""
    echo, place = random(1).uniform(0, 1, (3, 2, 4)), ("target_x", "target_y")
    whole, gain = echo.sum(axis=-1), np.array([[1.0, 1.2], [1.4, 1.6], [1.8, 2.0]])
    data = {"echo": ((*place, "pixel"), echo), "combined_echo": (("combination", *place), [whole, whole])}
    data["combined_detectability"] = (("combination", *place), [np.full((3, 2), 5.0), 5.0 * gain])
    coords = {"pixel": PIXELS, "combination": ["sum", "best"], "target_x": [-1.0, 0.0, 1.0], "target_y": [-2.0, 2.0]}
    return xr.Dataset(data, coords)


def frames():
    """Return three images by daylight with a glint in two of them."""
    radiance = random(4).uniform(2e-3, 4e-3, (3, 40, 50))
    radiance[0, 1, 2] = radiance[1, 3, 4] = 1.0
    angle_x, angle_y = np.meshgrid(np.linspace(3, -3, 40), np.linspace(4, -4, 50), indexing="ij")
    coords = {"angle_x": (("row", "column"), angle_x), "angle_y": (("row", "column"), angle_y)}
    coords["time_s"] = ("frame", [0.0, 0.25, 0.5])
    attributes = {"scene": "sea", "sun_zenith_deg": 40.0, "sky_distribution": "uniform"}
    return xr.Dataset({"radiance": (("frame", "row", "column"), radiance)}, coords, attributes)


def few_radiances():
    """Return radiances of two pixels that form no image."""
    data = {"radiance": ("pixel", [2e-3, 3e-3]), "radiance_stderr": ("pixel", [1e-4, 1e-4])}
    return xr.Dataset(data, {"pixel": ["a", "b"]})


def derivatives(pixels):
    """Return a waveform of 2 W in each pixel with a derivative of 0.5 +- 0.1 W m, by a parameter of 0.4 1/m."""
    slopes = np.full((1, pixels, 5), 0.5)
    data = {
        "waveform": (("pixel", "time"), np.full((pixels, 5), 2.0)),
        "waveform_derivative": (("parameter", "pixel", "time"), slopes),
        "waveform_derivative_stderr": (("parameter", "pixel", "time"), 0.2 * slopes),
    }
    coords = {"time": 1400.0 + np.arange(5), "parameter": ["attenuation"]}
    coords |= {"parameter_value": ("parameter", [0.4]), "parameter_units": ("parameter", ["1/m"])}
    return xr.Dataset(data, coords)


def profile(ratio=(0.02, 0.02, 0.02, 0.02)):
    """Return a profile of water whose share of backscattering may change with depth."""
    b = np.array([0.2, 0.6, 0.1, 0.1])
    return Profile([1.0, 4.0, 6.0, 10.0], [0.1, 0.3, 0.05, 0.05], b, np.array(ratio) * b)


def compared(pixels):
    """Return two results, one of them 10 % stronger, and how they agree."""
    first, second = (
        result(pixels, None if pixels < 5 else (10, 10), scale, passes=50, integrator=name)
        for scale, name in ((1.0, "one"), (1.1, "two"))
    )
    # What one of many pixels lacks in one result is left out of both.
    first["waveform"][7:8] = np.nan
    return first, second, compare(first, second)


#: A triangle, and a square with a hole.
OUTLINES = json.dumps([[[1, 2, 3, 2, 3, 4]], [[-4, -4, -4, 4, 0, 4, 0, -4], [-3, -1, -1, -1, -1, 1, -3, 1]]])
SQUARE = [1.084, -0.5, 2.084, -0.5, 2.084, 0.5, 1.084, 0.5, 1.084, -0.5]
TARGET = json.dumps([{"z": [-6.0, -6.0], "line": SQUARE, "seen": [0.4 * one for one in SQUARE]}])
VARYING = (0.005, 0.02, 0.01, 0.04)

FIGURES = {
    "waveforms": lambda: plot_waveforms(result()),
    "waveforms, linear": lambda: plot_waveforms(result(), scale="linear"),
    "waveforms of outlines": lambda: plot_waveforms(result(2, layout="", pixel_outlines=OUTLINES)),
    "waveforms of dots": lambda: plot_waveforms(result(3, layout="")),
    "waveforms of an image": lambda: plot_waveforms(result(6, (2, 3))),
    "waveforms of a series": lambda: plot_waveforms(series(*random(2).uniform(0.5, 2.0, 40), pixels=2)),
    "records of a series": lambda: plot_waveforms(detect_waveforms(series(1.0, 3.0), "photodiode", 1, 2)),
    "gates": lambda: plot_gates(stack()),
    "gates, logarithmic": lambda: plot_gates(stack(), log=True),
    "gates without depths": lambda: plot_gates(stack(gates=2).drop_vars("gate_depth")),
    "gates of pixels": lambda: plot_gates(stack(pixels=True)),
    "depths": lambda: plot_depths(stack(np.linspace(3, 4, 20).reshape(4, 5), gates=60)),
    "depths of pixels": lambda: plot_depths(stack(np.array([3.0, 3.5, 4.2]), True, 60)),
    "layout of dots": lambda: plot_layout(result()),
    "layout of an image": lambda: plot_layout(result(6, (2, 3))),
    "layout near the horizon": lambda: plot_layout(result(altitude=15.0, off_nadir_deg=84.6, field_of_view_mrad=20.0)),
    "layout with a target": lambda: plot_layout(result(target_outlines=TARGET)),
    "campaign": lambda: plot_campaign(campaign()),
    "campaign without echoes": lambda: plot_campaign(campaign().drop_vars("echo_flags")),
    "campaign without records": lambda: plot_campaign(campaign().drop_vars(["echo_flags", "waveform"])),
    "comparison": lambda: plot_comparison(*compared(2)),
    "comparison of an image": lambda: plot_comparison(*compared(100)),
    "derivatives of a pixel": lambda: plot_derivatives(derivatives(1)),
    "derivatives of pixels": lambda: plot_derivatives(derivatives(4)),
    "uncertainty": lambda: plot_uncertainty(uncertainty()),
    "uncertainty without echoes": lambda: plot_uncertainty(uncertainty().assign(tvu=lambda one: np.nan * one["tvu"])),
    "orders of surveys": lambda: plot_orders(uncertainty()),
    "forecast of a map": lambda: plot_forecast(forecast(True)),
    "forecast of a range": lambda: plot_forecast(forecast(False)),
    "depth bias": lambda: plot_depth_bias(depth_bias()),
    "found shots": lambda: plot_found_shots(found_shots()),
    "shots without waveforms": lambda: plot_found_shots(found_shots(waveforms=False)),
    "fit": lambda: plot_fit(fitted()),
    "fields of view": lambda: plot_fov_sweep(fov_sweep()),
    "orders of scattering": lambda: plot_scattering_orders(orders()),
    "shot statistics": lambda: plot_shot_statistics(shot_statistics()),
    "target": lambda: plot_target_signal(target_signal()),
    "map of a target": lambda: plot_target_map(target_map()),
    "daylight": lambda: plot_passive(frames(), frame=1),
    "daylight of pixels": lambda: plot_passive(few_radiances()),
    "phase function": lambda: plot_phase_function(fournier_forand_of(0.0183), "this", "water"),
    "pure sea water": lambda: plot_phase_function(water_phase_function, "this", "water"),
    "profile": lambda: plot_profile(profile(), profile().layers(0.1), "station"),
    "profile of backscattering": lambda: plot_profile(profile(VARYING), profile(VARYING).layers(0.02), "station"),
}
