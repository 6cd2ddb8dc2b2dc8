"""Draws the pictures of docs/concepts.md: ``python docs/images/draw_concepts.py [FOLDER]``, some seconds.

Directions, pixels and the record are the program's own. Rays are refracted by `physics.lidar`, pixels come from the
plugin ``multipixel_receiver``, and the record is a render.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Ellipse, Polygon

import mitransient_lidar
from mitransient_lidar.physics.lidar.level_sea import LevelSea, snell
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.plots import drawing, palette

INDEX = 1.34
SEA, WATER, SAND, GREY, BEAM, DIM = palette.BLUE, "#dcebf7", "#c9a86a", palette.GREY, palette.BEAM, "#333333"
FOUR = palette.pixel_colours(4)
NAMES = ("red", "green", "blue", "black")


def main(folder: Path) -> None:
    """Draw all pictures into a folder."""
    draw_frame(folder / "concepts_frame.png")
    draw_pixels(folder / "concepts_pixels.png")
    draw_widths(folder / "concepts_widths.png")
    draw_record(folder / "concepts_record.png")


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], colour: str, both: bool = False) -> None:
    """Draw an arrow, or with `both` one with two heads."""
    style = {"arrowstyle": "<|-|>" if both else "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", end, start, arrowprops=style)


def draw_frame(path: Path) -> None:
    """Draw the frame from the side and from above, with angles and ranges that are not to scale."""
    figure = drawing.new_figure(path, 11, 5.6)
    side, above = figure.subplots(1, 2, width_ratios=[1.35, 1])
    height, depth, axis, half_view, half_beam = 2.0, 1.3, np.radians(32), np.radians(6), np.radians(2.6)
    lidar = np.array([-height * np.tan(axis), 0, height])
    sea = LevelSea([INDEX], [])

    def places(angles: np.ndarray, z: float) -> np.ndarray:
        directions = np.column_stack([np.sin(angles), 0 * angles, -np.cos(angles)])
        return sea.at_height(lidar, directions, np.full(len(angles), z))[:, 0]

    side.set_title("From the side: the plane of incidence")
    x = np.linspace(-2.3, 2.6, 400)
    surface = 0.025 * np.sin(9 * x) + 0.012 * np.sin(23 * x + 1)
    side.fill_between(x, surface, -depth - 0.35, color=WATER, linewidth=0)
    side.plot(x, surface, color=SEA, linewidth=1.2)
    side.fill_between(x, np.full_like(x, -depth), -depth - 0.35, color=SAND, linewidth=0)
    side.axhline(0, color=GREY, linewidth=0.8, linestyle=":")
    for angle, style in ((axis - half_view, "near"), (axis, "axis"), (axis + half_view, "far")):
        meets, ends = (float(places(np.array([angle]), z)[0]) for z in (0.0, -depth))
        line = {"color": DIM, "linewidth": 1.6} if style == "axis" else {"color": GREY, "linewidth": 1}
        side.plot([lidar[0], meets, ends], [height, 0, -depth], zorder=3, **line)
        if style != "axis":
            side.text(ends, -depth - 0.17, f"{style} edge", ha="center", va="center", fontsize=9)
    edges = np.array([axis - half_beam, axis + half_beam])
    top, bottom = places(edges, 0.0), places(edges, -depth)
    side.add_patch(Polygon([(lidar[0], height), (top[0], 0), (top[1], 0)], color=BEAM, alpha=0.3, linewidth=0))
    beam = [(top[0], 0), (top[1], 0), (bottom[1], -depth), (bottom[0], -depth)]
    side.add_patch(Polygon(beam, color=BEAM, alpha=0.3, linewidth=0))
    side.plot([lidar[0]] * 2, [height, 0], color=GREY, linestyle="--", linewidth=1)
    side.text(lidar[0] - 0.05, 0.95, "altitude\n$H$", ha="right", va="center", fontsize=9)
    side.text(lidar[0] - 0.05, 0.12, "nadir", ha="right", fontsize=9)
    side.plot(lidar[0], height, "s", color=DIM, markersize=11)
    side.text(lidar[0] + 0.12, height + 0.05, "laser and receiver", fontsize=9)
    side.add_patch(Arc((lidar[0], height), 1.5, 1.5, theta1=270, theta2=270 + np.degrees(axis), color=SEA))
    side.text(lidar[0] + 0.24, height - 0.92, r"$\theta_0$", fontsize=12, color=SEA)
    wet = float(snell(axis, INDEX))
    side.plot([0, 0], [0, -depth], color=GREY, linestyle="--", linewidth=1)
    side.add_patch(Arc((0, 0), 1.3, 1.3, theta1=270, theta2=270 + np.degrees(wet), color=SEA))
    side.text(0.07, -0.82, r"$\theta_w$", fontsize=12, color=SEA)
    arrow(side, (1.75, 0), (1.75, -depth), DIM, both=True)
    side.text(1.82, -0.62, "depth $D$", fontsize=9, va="center")
    arrow(side, (0, 0), (1.5, 0), "black")
    arrow(side, (0, 0), (0, 0.8), "black")
    side.text(1.55, 0.07, "x", fontsize=12)
    side.text(0.06, 0.72, "z, up", fontsize=11)
    side.text(1.72, 0.07, "mean sea level,\nz = 0", fontsize=9, color=SEA)
    side.text(-2.25, -0.3, "refractive index bends rays,\ngroup index delays pulses", fontsize=9, color=SEA, va="top")
    side.set(xlim=(-2.3, 2.6), ylim=(-depth - 0.35, 2.3), aspect="equal", xticks=[], yticks=[])

    above.set_title("From above: a map of the sea, +x upwards")
    stretch, view, spot = 1.5, 1.0, 0.4
    circle = np.linspace(0, 2 * np.pi, 200)
    for index, first in enumerate((0, 270, 90, 180)):
        # Quadrants, counter-clockwise from +x upwards: far left, far right, near left, near right.
        part = np.radians(np.linspace(first, first + 90, 50))
        outline = np.column_stack([-view * np.sin(part), stretch * view * np.cos(part)])
        above.add_patch(Polygon([(0, 0), *outline.tolist()], facecolor=FOUR[index], alpha=0.33, edgecolor="white"))
        middle = np.radians(first + 45)
        above.text(-0.68 * np.sin(middle), 1.02 * np.cos(middle), f"{index} {NAMES[index]}", ha="center", va="center")
    above.plot(-view * np.sin(circle), stretch * view * np.cos(circle), color=GREY)
    above.add_patch(Ellipse((0, 0), 2 * spot, 2 * spot * stretch, facecolor="none", edgecolor=BEAM, linewidth=2))
    above.text(0.44, -0.16, "beam", color=BEAM, fontsize=9)
    arrow(above, (0, 0), (0, 1.95), "black")
    arrow(above, (0, 0), (-1.5, 0), "black")
    above.text(0.06, 1.83, "x, angle_x: far", fontsize=10)
    above.text(-1.72, 0.07, "y, angle_y:\nleft", fontsize=10)
    above.plot(0, -2.15, "s", color=DIM, markersize=11)
    above.text(0.15, -2.15, "point below\nlaser and receiver", fontsize=9, va="center")
    above.plot([0, 0], [-2.15, 0], color=GREY, linestyle="--", linewidth=1)
    above.text(1.06, 0.9, "field\nof view", fontsize=9, color=DIM)
    above.set(xlim=(-1.75, 1.75), ylim=(-2.4, 2.15), aspect="equal", xticks=[], yticks=[])
    drawing.save(figure, path)


def draw_pixels(path: Path) -> None:
    """Draw the pixels in four layouts as the lidar sees them."""
    import mitsuba as mi

    from mitransient_lidar.transport.sensor.outlines import pixel_outlines

    figure = drawing.new_figure(path, 11, 3.1)
    axes = figure.subplots(1, 4)
    for ax, layout in zip(axes, ("2x2", "1x4", "hex7", "4x6"), strict=True):
        shape = {"field_of_view_shape": "square", "imager": True} if layout == "4x6" else {}
        film = {"type": "time_gated_film", "bin_count": 1, "time_start_ns": 0.0}
        sensor = mi.load_dict({"type": "multipixel_receiver", "layout": layout, "film": film, **shape})
        pixels = sensor.receiver.pixels
        centres = 1e3 * np.asarray(pixels.centres())
        for index, (loops, centre) in enumerate(zip(pixel_outlines(pixels), centres, strict=True)):
            colour = FOUR[index] if pixels.count == 4 else palette.pixel_colours(pixels.count)[index]
            for loop in loops:
                ax.add_patch(Polygon(1e3 * loop[:, ::-1], facecolor=colour, alpha=0.35, edgecolor="white"))
            label = f"{index}\n{NAMES[index]}" if pixels.count == 4 else f"{index}"
            label = f"{index // 6},{index % 6}" if layout == "4x6" else label
            ax.text(centre[1], centre[0], label, ha="center", va="center", fontsize=9)
        ax.set_title(f"{layout}: row, column" if layout == "4x6" else layout, fontsize="medium")
        ax.set(xlim=(16.5, -16.5), ylim=(-16.5, 16.5), aspect="equal", xlabel="left, angle_y (mrad)")
        ax.set_ylabel("far, angle_x (mrad)" if ax is axes[0] else "")
    drawing.save(figure, path)


def draw_widths(path: Path) -> None:
    """Draw how a beam's width is defined, and a pulse in bins."""
    figure = drawing.new_figure(path, 11, 3.6)
    beam, pulse = figure.subplots(1, 2)
    sigma = 5.0
    angle = np.linspace(-16, 16, 400)
    beam.plot(angle, np.exp(-0.5 * (angle / sigma) ** 2), color=BEAM, linewidth=2)
    widths = {"divergence_mrad: e$^{-1/2}$": np.exp(-0.5), "divergence_fwhm_mrad: half": 0.5}
    for name, level in {**widths, "divergence_1e2_mrad: e$^{-2}$": np.exp(-2)}.items():
        half = sigma * np.sqrt(-2 * np.log(level))
        arrow(beam, (-half, level), (half, level), DIM, both=True)
        beam.text(half + 1, level, f"{name}, {2 * half:.1f} mrad", fontsize=9, va="center")
    beam.set(xlabel="angle from the axis (mrad)", ylabel="irradiance over its peak", xlim=(-16, 57), ylim=(0, 1.08))
    beam.set_title("One Gaussian beam and its three widths")

    fwhm, width = 5.0, 1.0
    shape = Pulse.gaussian(fwhm)
    first, weights = shape.kernel(width, 0.0)
    bins = first + np.arange(len(weights))
    # kernel() has the energy of an echo in the middle of bin 0, which arrives at 0 here.
    pulse.stairs(weights / width, np.append(bins, bins[-1] + 1) - 0.5, fill=True, color=SEA, alpha=0.3)
    edges = np.linspace(-8, 8, 401)
    power = np.gradient(shape.cumulative(edges), edges)
    pulse.plot(edges, power, color=SEA, linewidth=2)
    arrow(pulse, (-fwhm / 2, power.max() / 2), (fwhm / 2, power.max() / 2), DIM, both=True)
    pulse.text(0, power.max() / 2 + 0.004, "pulse_fwhm_ns", fontsize=9, ha="center")
    pulse.axvline(0, color=GREY, linestyle="--", linewidth=1)
    pulse.text(0.15, 1.04 * power.max(), "time of the pulse", fontsize=9)
    pulse.set(xlabel="time (ns)", ylabel="power over energy (1/ns)", xlim=(-8, 8), ylim=(0, 1.14 * power.max()))
    pulse.set_title("A pulse, and its means in bins of 1 ns")
    drawing.save(figure, path)


def draw_record(path: Path) -> None:
    """Draw one pixel's record over a level sea: energy by bin and power after the pulse, with both axes."""
    params = {"layout": "1x1", "spectrum": "flat"}
    shot = mitransient_lidar.render("table1", params=params, passes=64, seed=1).isel(pixel=0)
    figure = drawing.new_figure(path, 11, 4.2)
    ax = figure.subplots()
    time = shot["time"].values
    energy = 1e9 * shot["impulse_response"].values / float(shot.attrs["bin_width_ns"])
    ax.step(time, 1e6 * energy, where="mid", color=GREY, linewidth=1, label="impulse_response over the bin's width")
    power, error = (1e6 * shot[name].values for name in ("waveform", "waveform_stderr"))
    drawing.draw_band(ax, time, power, 2 * error, lowest=1e-3, color=SEA, linewidth=2, label="waveform, ± 2 errors")
    surface, scale = float(shot["surface_time"]), float(shot["depth_per_ns"])
    for at, text in ((surface, "surface_time"), (surface + float(shot.attrs["bottom_point"][2]) / -scale, "bottom")):
        ax.axvline(at, color="black", linestyle=":", linewidth=1)
        ax.text(at + 0.6, 2.2e3, text, fontsize=9)
    window = shot.attrs["window_start_ns"], shot.attrs["window_end_ns"]
    ax.axvspan(*window, facecolor="#f2efe6", edgecolor="#b8ab80", zorder=0, label="window whose errors end a render")
    ax.set(xlabel=drawing.TIME_LABEL, ylabel="received power (µW)", yscale="log", ylim=(0.2, 6e3))
    ax.set(xlim=(surface - 25, surface + 110))
    drawing.add_top_axis(ax, -surface * scale, scale, "depth on the line of sight (m)")
    ax.legend(loc="upper center", frameon=False)
    drawing.save(figure, path)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
