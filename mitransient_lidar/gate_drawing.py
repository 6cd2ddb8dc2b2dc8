"""What the pictures of gate stacks share: scale, captions, axes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.optics.checks import FloatArray
from mitransient_lidar.results import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

SIGNIFICANT = 3.0  #: Standard errors from which a value counts on a logarithmic scale.

_BRIGHT = 99.0  # percentile of the pixels of a gate that fits into the colours: a small bright target may be clipped
_DECADES = 3.0  # of a logarithmic colour scale
_DPI = 150


class ColourScale(NamedTuple):
    """Common colours of all gates of a stack."""

    factor: float  #: Energy that counts as one [J].
    unit: str  #: Its name, such as "aJ".
    norm: Normalize  #: From energies in that unit to colours.
    label: str  #: Says how many values are brighter than the brightest colour.
    extend: Literal["neither", "min", "max", "both"]  #: Ends beyond which values lie.

    def add_bar(
        self, figure: Figure, image: AxesImage, axes: Any, label: str | None = None, **options: Any
    ) -> Colorbar:
        """Draw the colour bar along a row of axes, with plain numbers on a logarithmic scale too."""
        from matplotlib.colors import LogNorm
        from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

        bar = figure.colorbar(image, ax=axes, extend=self.extend, **options)
        if isinstance(self.norm, LogNorm):
            bar.locator = LogLocator(subs=(1.0, 2.0, 5.0))
            bar.formatter = FuncFormatter(lambda value, _: f"{value:g}")
            bar.minorformatter = NullFormatter()
            bar.update_ticks()
        bar.set_label(label or self.label)
        return bar


def draw_image(ax: Axes, values: FloatArray, extent: tuple[float, float, float, float], norm: Normalize) -> AxesImage:
    """Draw the image of one gate; pixels that are not finite are grey."""
    import matplotlib as mpl

    colours = mpl.colormaps["magma"].with_extremes(bad="0.6")
    return ax.imshow(values, extent=extent, norm=norm, cmap=colours, interpolation="nearest")


def colour_scale(stack: xr.Dataset, *, log: bool) -> ColourScale:
    """Return the common colours of the gates of an imager.

    They end at the largest of the 99th percentiles of the gates below the surface echo. Where the time of that echo is
    not known, they end at the value that one gate in ten exceeds with its 99th percentile.
    """
    from matplotlib.colors import LogNorm, Normalize

    from mitransient_lidar.plotting import si_prefix

    energy, stderr = stack["gate_energy"].values, stack["gate_energy_stderr"].values
    finite = np.where(np.isfinite(energy), energy, 0.0)
    tops = np.percentile(finite, _BRIGHT, axis=(0, 1))
    below = ~reached_by_surface(stack)
    if "surface_time_ns" not in stack.attrs:
        top = float(np.percentile(tops, 90))
    else:
        top = float(tops[below].max() if below.any() else tops.max())
    if top <= 0:
        top = float(finite.max()) if finite.max() > 0 else 1.0
    brighter = np.count_nonzero(finite > top) / finite.size
    factor, prefix = si_prefix(top)
    label = f"energy in the gate ({prefix}J)"
    if brighter:
        what = "of the values" if below.all() else "of the values, the surface echo among them,"
        label += f"; {100 * brighter:.2g} % {what} are brighter"
    if not log:
        return ColourScale(factor, f"{prefix}J", Normalize(0.0, top / factor), label, "max" if brighter else "neither")
    significant = finite[(finite > SIGNIFICANT * stderr) & (finite > 0)]
    bottom = max(top * 10.0**-_DECADES, float(np.percentile(significant, 1)) if significant.size else 0.0)
    # Clipped, so that values of 0 and below are dark and not missing.
    norm = LogNorm(min(bottom, 0.5 * top) / factor, top / factor, clip=True)
    return ColourScale(factor, f"{prefix}J", norm, label, "both" if brighter else "min")


def reached_by_surface(stack: xr.Dataset) -> npt.NDArray[np.bool_]:
    """Tell which gates are open while the surface echo or something before it arrives; none where it is not known."""
    from mitransient_lidar.plotting import number

    surface = number(stack.attrs, "surface_time_ns")
    if surface is None:
        return np.zeros(stack.sizes["gate"], dtype=bool)
    # Waves and the width of the image spread the echo by some more than the pulse does.
    lengths = (number(stack.attrs, name) or 0.0 for name in ("pulse_fwhm_ns", "response_time_ns", "gate_rise_ns"))
    reached: npt.NDArray[np.bool_] = stack["gate_start"].values < surface + 1.5 * sum(lengths)
    return reached


def known_depths(stack: xr.Dataset) -> FloatArray | None:
    """Return the depths of the gates' middles [m], None where they are not known."""
    if "gate_depth" not in stack.coords or not np.isfinite(stack["gate_depth"].values).all():
        return None
    depths: FloatArray = stack["gate_depth"].values.astype(np.float64)
    return depths


def caption(stack: xr.Dataset, index: int) -> tuple[str, str]:
    """Return a gate's number and depth, and when it is open."""
    start, width = (float(stack[name].values[index]) for name in ("gate_start", "gate_width"))
    depths = known_depths(stack)
    depth = "" if depths is None else f"  {depths[index]:.2f} m"
    return f"#{index}{depth}", f"{start:.1f} to {start + width:.1f} ns"


def extent_mrad(stack: xr.Dataset) -> tuple[float, float, float, float]:
    """Return the edges of the image [mrad]: left, right, near and far."""
    gx, gy = stack["gx"].values, stack["gy"].values
    half_row = 0.5 * (abs(gx[0, 0] - gx[-1, 0]) / (len(gx) - 1) if len(gx) > 1 else 1.0)
    half_column = 0.5 * (abs(gy[0, -1] - gy[0, 0]) / (gy.shape[1] - 1) if gy.shape[1] > 1 else 1.0)
    edges = (gy.min() - half_column, gy.max() + half_column, gx.min() - half_row, gx.max() + half_row)
    return float(edges[0]), float(edges[1]), float(edges[2]), float(edges[3])


def scene_name(stack: xr.Dataset) -> str:
    """Return how a title begins: with the scene's name, where it has one."""
    scene = Path(str(stack.attrs.get("scene", ""))).stem
    return f"{scene}: " if scene else ""


def sheet_title(stack: xr.Dataset, shown: int) -> str:
    """Return the title of a picture of `shown` gates of a stack."""
    count, width = stack.sizes["gate"], float(stack["gate_width"].values[0])
    which = f"{count} gates" if shown == count else f"{shown} of {count} gates"
    pulses = int(stack.attrs.get("pulses", 1))
    return f"{scene_name(stack)}{which} of {width:g} ns" + (f", {pulses} pulses" if pulses > 1 else "")


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure, whole or not at all."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)
