"""Film plugin ``time_gated_film``: time histograms of every pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import finite, positive, whole
from mitransient_lidar.optics.water import C0

#: More bins than this do not fit the memory of a laptop.
_LARGEST_FILM = 2**28


class TimeGatedFilm(mi.Film):
    r"""Time histogram of received energy, one for each pixel (``time_gated_film``).

    ===================  =======  ======================================================================================
    Parameter            Type     Meaning
    ===================  =======  ======================================================================================
    time_start_ns        float    Start of the first bin [ns], with 0 when the pulse's peak leaves the transmitter.
                                  Default: 1390
    bin_width_ns         float    Width of a bin [ns], positive. Default: 0.5
    bin_count            integer  Number of bins, 1 to 1 000 000. Default: 320
    ===================  =======  ======================================================================================

    Bins are half open, [start, start + width). ``develop`` returns the energy [J] of the last pass as a tensor
    (pixel, time), or (row, column, time) for imagers. Sums are kept in double precision.

    .. code-block:: xml

        <film type="time_gated_film">
            <float name="time_start_ns" value="1390"/>
            <float name="bin_width_ns" value="0.5"/>
            <integer name="bin_count" value="320"/>
        </film>

    .. code-block:: python

        {'type': 'time_gated_film', 'time_start_ns': 1390.0, 'bin_width_ns': 0.5, 'bin_count': 320}
    """

    def __init__(self, props: mi.Properties) -> None:
        self.time_start_ns = finite("time_start_ns", props.get("time_start_ns", 1390.0))
        self.bin_width_ns = positive("bin_width_ns", props.get("bin_width_ns", 0.5))
        self.bin_count = whole("bin_count", props.get("bin_count", 320), 1, 1_000_000)
        props["width"], props["height"] = self.bin_count, 1
        super().__init__(props)
        self._shape: tuple[int, ...] = (1,)
        self._start = self.time_start_ns * 1e-9 * C0
        self._per_metre = 1 / (self.bin_width_ns * 1e-9 * C0)
        self._energy = dr.zeros(mi.Float64, self.bin_count)

    @property
    def path_end(self) -> float:
        """Optical path length at which the record ends [m]."""
        return (self.time_start_ns + self.bin_width_ns * self.bin_count) * 1e-9 * C0

    def prepare_pixels(self, pixel_count: int, grid: tuple[int, int] | None = None) -> None:
        """Clear the histogram and make room for the pixels.

        Parameters
        ----------
        pixel_count
            Number of pixels.
        grid
            (rows, columns) of an imager, or None.

        Raises
        ------
        ValueError
            When pixels times bins exceed 2^28.
        """
        if pixel_count * self.bin_count > _LARGEST_FILM:
            raise ValueError(
                f"bin_count = {self.bin_count} times {pixel_count} pixels must not exceed {_LARGEST_FILM} bins in all"
            )
        self._shape = grid or (pixel_count,)
        self._energy = dr.zeros(mi.Float64, pixel_count * self.bin_count)

    def add_transient(self, pixel: mi.UInt32, path_length: mi.Float, energy: mi.Float, active: mi.Bool) -> None:
        """Add energy [J] that arrives after an optical path of `path_length` metres (group index included)."""
        position = (path_length - self._start) * self._per_metre
        active = active & (position >= 0) & (position < self.bin_count)
        index = pixel * self.bin_count + dr.minimum(mi.UInt32(position), self.bin_count - 1)
        dr.scatter_add(self._energy, mi.Float64(energy), index, active)

    def energy(self) -> np.ndarray:
        """Return the energy [J] of the last pass as float64, shape (pixels, time) or (rows, columns, time)."""
        return np.array(self._energy).reshape(*self._shape, self.bin_count)

    def develop(self, raw: bool = False) -> mi.TensorXf:
        """Return the energy [J] of the last pass, (pixel, time) or (row, column, time)."""
        return mi.TensorXf(mi.Float(self._energy), (*self._shape, self.bin_count))

    def clear(self) -> None:
        """Set all bins to zero."""
        self._energy = dr.zeros(mi.Float64, dr.width(self._energy))

    def bitmap(self, raw: bool = False) -> mi.Bitmap:
        """Return the histograms as a bitmap, time along x and pixels along y."""
        return mi.Bitmap(mi.TensorXf(mi.Float(self._energy), (int(np.prod(self._shape)), self.bin_count, 1)))

    def write(self, path: str) -> None:
        """Write the bitmap of `bitmap` to an EXR file; ``mitransient_lidar.render`` writes the full stack."""
        self.bitmap().write(path)

    def prepare(self, aovs: list[str]) -> int:
        """Clear the histogram for an integrator that is not a lidar integrator."""
        self.clear()
        return 1

    def base_channels_count(self) -> int:
        """Return 1: energy."""
        return 1

    def put_block(self, block: mi.ImageBlock) -> None:
        """Refuse: image blocks know no time."""
        raise ValueError("time_gated_film records time: use the integrator lidar_volpath")

    def create_block(self, size: object = None, normalize: bool = False, borders: bool = False) -> mi.ImageBlock:
        """Refuse: image blocks know no time."""
        raise ValueError("time_gated_film records time: use the integrator lidar_volpath")

    def schedule_storage(self) -> None:
        """Schedule the histogram for evaluation."""
        dr.schedule(self._energy)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: a changed film is loaded anew."""

    def to_string(self) -> str:
        """Return a description."""
        return (
            f"TimeGatedFilm[time_start_ns={self.time_start_ns:g}, bin_width_ns={self.bin_width_ns:g}, "
            f"bin_count={self.bin_count}]"
        )


mi.register_film("time_gated_film", lambda props: TimeGatedFilm(props))
