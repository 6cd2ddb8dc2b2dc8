"""Compare forecasts with flights over sloping bottoms: the table of ``docs/guide/forecast.md``.

``python tests/forecast_flights.py`` flies 600 pulses a case, takes the forecast at the true depth of each, and prints
the shares of pulses that find the bottom within 1 m of the truth, and the deepest depths.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import mitransient_lidar
from mitransient_lidar.analysis.waveforms.echo_classes import EchoClass
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.renderer import FlightRenderer

SCENE = """<scene version="3.0.0">
    <default name="wind_speed" value="5"/>
    <integrator type="lidar_merging"/>
    <emitter type="lidar_transmitter" id="transmitter"/>
    <sensor type="multipixel_receiver" id="receiver"><film type="time_gated_film"/></sensor>
    <shape type="ocean_surface" id="surface">
        <float name="wind_speed" value="$wind_speed"/>
        <medium type="layered_water" name="interior"/>
    </shape>
    <shape type="seabed" id="bottom">
        <float name="depth" value="{depth}"/>
        <float name="slope_x_deg" value="{slope}"/>
        <float name="reflectance" value="0.15"/>
        <float name="size" value="{size}"/>
    </shape>
</scene>
"""
#: Instrument, scanner, water, wind [m/s], depths and height [m], slope of the bottom [deg] and light of each case.
CASES = [
    ("riegl_vq840g", "palmer", "1C", 5.0, (2.5, 14.8), 75.0, 3.0, "maps"),
    ("riegl_vq880g2", "palmer", "1C", 3.0, (3.0, 14.1), 600.0, 1.0, "maps"),
    ("published_airborne", "semi_arc", "5C", 6.0, (4.9, 10.7), 200.0, 1.0, "merging"),
]
SPEED, PULSES, RIGHT = 25.0, 600, 1.0


def flown(case: tuple, gain: float | None, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return true depths of pulses below the sea, and which find the bottom in the best pixel; None: automatic gain."""
    instrument, scanner, water, wind, (low, high), height, slope, light = case
    whole = (high - low) / np.tan(np.radians(slope))
    length = whole - 2 * height * np.tan(np.radians(20.0))  # of the track: the scanner looks beyond it
    (folder / "slope.xml").write_text(SCENE.format(depth=0.5 * (low + high), slope=slope, size=whole + 20))
    duration = length / SPEED
    plan = FlightPlan.of_file(
        {
            **{"scene": "slope.xml", "instrument": instrument, "light": light, "seed": 1},
            "parameters": {"jerlov": water, "wind_speed": wind},
            "platform": {
                **{"kind": "lines", "start": [0.5 * length, 0.0], "heading_deg": 270.0, "speed": SPEED},
                **{"height": height, "duration_s": duration},
            },
            "scanner": {"kind": scanner, "nadir_angle_deg": 20.0, "rate_hz": 5.0},
            "pulses": {"rate_hz": PULSES / duration, "most": PULSES},
            **({} if gain is None else {"receiver": {"gain": gain}}),
        },
        folder,
    )
    renderer, columns = FlightRenderer.of(plan)
    depths, found = [], []
    for batch in renderer.batches(columns):
        arrays = renderer.stacked(np.array(batch), {name: values[batch] for name, values in columns.items()})
        values = {
            name: arrays[name].values for name in ("echo_class", "echo_depth_m", "true_bottom_depth_below_surface")
        }
        truth = values["true_bottom_depth_below_surface"]
        depth = values["echo_depth_m"].reshape(*values["echo_class"].shape)[..., -1]
        wet = np.isin(values["echo_class"][..., -1], [EchoClass.BOTTOM, EchoClass.MERGED])
        depths.append(truth)
        found.append(wet & (np.abs(depth - truth[:, None]) < RIGHT))
    of_pixels = np.concatenate(found)
    return np.concatenate(depths), of_pixels[:, np.argmax(of_pixels.mean(axis=0))]


def deepest(depth: np.ndarray, found: np.ndarray) -> tuple[float, float]:
    """Return the depth at which a logistic curve through the pulses is one half, and its standard error [m]."""

    def cost(values: np.ndarray) -> float:
        middle, log_width = values
        z = (middle - depth) / np.exp(log_width)
        return float(np.sum(np.logaddexp(0, np.where(found, -z, z))))

    fit = minimize(cost, [np.median(depth), -0.5])
    return float(fit.x[0]), float(np.sqrt(fit.hess_inv[0, 0]))


def main() -> None:
    print(
        "instrument          depths [m]    found by the flight  forecast  deepest, flight   forecast  forecast's time"
    )
    for case in [CASES[int(number)] for number in sys.argv[1:]] or CASES:
        instrument, _, water, wind, (low, high), height, *_ = case
        params = {"jerlov": water, "wind_speed": wind, "bottom_reflectance": 0.15, "altitude": height}
        begun = time.process_time()
        forecast = mitransient_lidar.forecast(instrument, f"{low}:{high}", {**params, "off_nadir_deg": 20.0})
        seconds = time.process_time() - begun
        for gain in (float(np.max(forecast.attrs["gain"])), None):
            with tempfile.TemporaryDirectory() as folder:
                depth, found = flown(case, gain, Path(folder))
            known = np.isfinite(depth)
            depth, found = depth[known], found[known]
            chance = np.interp(depth, forecast["depth"].values, forecast["found"].values)
            error = np.sqrt(np.mean(chance * (1 - chance)) / depth.size)
            middle, spread = deepest(depth, found)
            share = f"{100 * found.mean():5.1f} +- {100 * error:.1f} %"
            print(
                f"{instrument:19} {'automatic gain' if gain is None else f'gain {gain:.3g}':14}",
                f"{depth.min():5.1f} to {depth.max():4.1f}  {share}  {100 * chance.mean():5.1f} %",
                f"     {middle:6.2f} +- {spread:.2f} {float(np.nanmedian(forecast['deepest'])):6.2f}  {seconds:5.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
