"""Film plugin ``time_gated_film``: time histograms of every pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import finite, positive, whole
from mitransient_lidar.optics.water import C0

#: More bins than this do not fit the memory of a laptop.
_LARGEST_FILM = 2**28

#: Bits of the coarse sums below the emitted energy, of the fine sums below those, and number of coarse units below
#: which energies are summed finely. Coarse sums hold 64 times what is emitted; fine ones 2^23 of the largest they take.
_COARSE_BITS, _FINE_BITS, _COARSEST_FINE = 57, 32, 2.0**8


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
    (pixel, time), or (row, column, time) for imagers. Sums are kept as whole numbers of two units, so that they do not
    depend on their order: the same seed gives the same bits, and pixels sum exactly to the whole.

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
        self._units = 1.0, 1.0
        self._sums = dr.zeros(mi.Int64, 2 * self.bin_count)
        self._invalid = dr.zeros(mi.UInt32, self.bin_count)

    @property
    def _count(self) -> int:
        """Number of bins of all pixels."""
        return int(np.prod(self._shape)) * self.bin_count

    @property
    def path_end(self) -> float:
        """Optical path length at which the record ends [m]."""
        return (self.time_start_ns + self.bin_width_ns * self.bin_count) * 1e-9 * C0

    def prepare_pixels(self, pixel_count: int, emitted: float, grid: tuple[int, int] | None = None) -> None:
        """Clear the histogram and make room for the pixels.

        Parameters
        ----------
        pixel_count
            Number of pixels.
        emitted
            Energy that the laser emits [J]: no bin can receive more.
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
        self._units = emitted * 2.0**-_COARSE_BITS, emitted * 2.0 ** -(_COARSE_BITS + _FINE_BITS)
        self.clear()

    def add_transient(self, pixel: mi.UInt32, path_length: mi.Float, energy: mi.Float, active: mi.Bool) -> None:
        """Add energy [J] that arrives after an optical path of `path_length` metres (group index included)."""
        position = (path_length - self._start) * self._per_metre
        active = active & (position >= 0) & (position < self.bin_count)
        index = pixel * self.bin_count + dr.minimum(mi.UInt32(position), self.bin_count - 1)
        valid = dr.isfinite(energy)
        dr.scatter(self._invalid, mi.UInt32(1), index, active & ~valid)
        coarse, fine = self._units
        small = energy < _COARSEST_FINE * coarse
        number = mi.Int64(dr.round(energy * dr.select(small, mi.Float(1 / fine), mi.Float(1 / coarse))))
        dr.scatter_add(self._sums, number, index + dr.select(small, mi.UInt32(self._count), 0), active & valid)

    def energy(self) -> np.ndarray:
        """Return the energy [J] of the last pass as float64, shape (pixels, time) or (rows, columns, time).

        Bins to which something not finite was added are NaN.
        """
        coarse, fine = np.array(self._sums).reshape(2, self._count)
        energy = coarse * self._units[0] + fine * self._units[1]
        energy[np.array(self._invalid) > 0] = np.nan
        return np.asarray(energy.reshape(*self._shape, self.bin_count))

    def develop(self, raw: bool = False) -> mi.TensorXf:
        """Return the energy [J] of the last pass, (pixel, time) or (row, column, time)."""
        return mi.TensorXf(self.energy().astype(np.float32))

    def clear(self) -> None:
        """Set all bins to zero."""
        self._sums = dr.zeros(mi.Int64, 2 * self._count)
        self._invalid = dr.zeros(mi.UInt32, self._count)

    def bitmap(self, raw: bool = False) -> mi.Bitmap:
        """Return the histograms as a bitmap, time along x and pixels along y."""
        return mi.Bitmap(mi.TensorXf(self.energy().reshape(-1, self.bin_count, 1).astype(np.float32)))

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
        dr.schedule(self._sums, self._invalid)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: a changed film is loaded anew."""

    def to_string(self) -> str:
        """Return a description."""
        return (
            f"TimeGatedFilm[time_start_ns={self.time_start_ns:g}, bin_width_ns={self.bin_width_ns:g}, "
            f"bin_count={self.bin_count}]"
        )


mi.register_film("time_gated_film", lambda props: TimeGatedFilm(props))
