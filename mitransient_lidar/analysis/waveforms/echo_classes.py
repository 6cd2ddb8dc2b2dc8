"""Echo classes: sea, land, and objects above the water."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mitransient_lidar.analysis.waveforms.echo_detection import (
    BEHIND_EDGE,
    BoolArray,
    DetectedEchoes,
    Echoes,
    EchoFlag,
    IntArray,
    Records,
    error_of_sums,
    find_echoes,
)
from mitransient_lidar.analysis.waveforms.echo_detection import (
    EchoClass as EchoClass,
)
from mitransient_lidar.analysis.waveforms.echo_shape import EchoShape
from mitransient_lidar.analysis.waveforms.first_echoes import SEPARATE, FirstEchoes, Priors, first_echoes
from mitransient_lidar.analysis.waveforms.records import Rows, Waveforms
from mitransient_lidar.analysis.waveforms.surface_times import GRAZING, SurfaceLevel
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray

#: Distance in air per two-way time [m/ns].
IN_AIR = 0.5e-9 * C0

#: Largest probability of an echo that may be a single event of the detector.
FEW_EVENTS_CHANCE = 0.5

_FAR = 4.0  # standard deviations of the surface's time beyond which an echo before others stands above the water
_APART = 1.2  # least separation of two echoes of which the first one stands above the water, in echo widths
_WEAK, _FAR_APART = 15.0, 8.0  # height of a weak first echo over the noise, and farthest others behind it, in widths
_TWICE, _SECOND = 0.1, 5.0  # of a peak, light that meets the bottom twice, and its farthest distance in echo widths
# Its delays over those of the bottom, and its largest height times delay over width.
_RETURNS, _BRIGHTEST = (2.2, 3.2), 0.5
# Standard errors of a column's energy that make the echo before it the surface's, and its length [ns].
_COLUMN, _COLUMN_NS = 5.0, 20.0
_LEAST_BOTTOM = 0.25  # probability of a clear bottom over the surface's from which it counts instead
_CLEAR = 8.0  # least height over the noise of clear echoes
_SHALLOW = 2.0  # largest depth of bottoms that are told from first echoes [m]
_OF_EVENTS = 0.5  # variance over mean signal of samples with single events, relative to the height that these reach
_OPEN = 2.0  # least length of a column between two echoes that tells a weak surface, in echo widths


class Detection(NamedTuple):
    """Options of `echo_detection.find_echoes`."""

    threshold: float
    contrast: float
    targets: int | None


@dataclass(frozen=True)
class Decision:
    """Echoes of n records whose first echoes are decided upon."""

    found: DetectedEchoes  #: The echoes; land, and bottoms without a surface, are the last ones.
    above: BoolArray  #: Which of them stand above the water, shape (echoes, n).
    probability: FloatArray  #: That of the class of the first echo, shape (n,); 1 where echoes are apart.
    #: Records whose first echo is land, or a bottom near its surface, and what is decided of them.
    rows: IntArray
    first: FirstEchoes | None = None

    @property
    def land(self) -> BoolArray:
        """Which of `rows` are land."""
        assert self.first is not None
        return np.asarray(self.first.chance[0] >= self.first.chance[2])

    def fitted(self, echoes: list[Echoes]) -> list[Echoes]:
        """Return fitted echoes, surface first and bottom last, with those of the joint fits in their places."""
        if self.first is None:
            return echoes
        replaced = list(echoes)
        for place, own in ((0, self.first.surface), (-1, self.first.bottom)):
            values = {name: np.array(value) for name, value in vars(echoes[place]).items()}
            for name in values.keys() - {"flags"}:
                values[name][self.rows] = getattr(own, name)
            values["flags"][self.rows] &= ~int(EchoFlag.POOR_FIT)
            replaced[place] = Echoes(**values)
        return replaced

    def surfaces(self) -> tuple[FloatArray, FloatArray]:
        """Return time and error [ns] of surfaces without their own echo before a near bottom, else NaN."""
        time, error = np.full((2, len(self.probability)), np.nan)
        if self.first is not None:
            own = np.isnan(self.first.surface.time_ns)
            time[self.rows[own]], error[self.rows[own]] = self.first.surface_ns[own], self.first.surface_stderr[own]
        return time, error

    def films(self) -> FloatArray:
        """Return the delays by water that may stand on land [ns], shape (n,), 0 without land."""
        delay = np.zeros(len(self.probability))
        if self.first is not None:
            delay[self.rows] = np.where(self.land, self.first.film_ns, 0.0)
        return delay

    def classes(self, width: float) -> IntArray:
        """Return the `EchoClass` of surface, targets and bottom, shape (n, echoes), for an echo width [ns]."""
        exists = self.found.bins >= 0
        objects = np.where(self.above, int(EchoClass.ABOVE), int(EchoClass.OBJECT))
        classes = np.where(exists, objects, int(EchoClass.NONE))
        for place, own in ((0, EchoClass.SURFACE), (-1, EchoClass.BOTTOM)):
            classes[place] = np.where(exists[place], int(own), classes[place])
        if self.first is not None:
            near = self.first.bottom.time_ns - self.first.surface_ns < SEPARATE * width
            wet = np.where(near, int(EchoClass.MERGED), int(EchoClass.BOTTOM))
            classes[-1, self.rows] = np.where(self.land, int(EchoClass.LAND), wet)
        return classes.T


def decide(
    waveforms: Waveforms,
    part: Rows,
    records: Records,
    level: SurfaceLevel,
    decay: float,
    detection: Detection,
) -> Decision:
    """Find the echoes of records, and decide what the first ones are.

    That is for angles below 60 degrees, and bottoms less than 2 m deep: others are those of `find_echoes`.
    An echo that is more than 4 standard deviations before the surface's level, and 1.2 echo widths before others, is an
    object above the water. First echoes without others, or with others nearer than 1.8 echo widths, are those of
    `first_echoes.first_echoes`, unless they are at the surface's level and a column follows them. The likeliest of
    land, surface and bottom counts, however faint the echo is. Above 8 standard errors, a bottom that is likelier than
    land is preferred to a surface without a column that is at most four times as likely. In the near infrared, where
    column and bottom are part of the surface's echo, a first echo is land or the surface, and nothing follows the
    surface.
    Samples have at least the noise of the detector's single events in them. A bottom that is no higher than these, and
    has no surface, has a probability of one half.

    150 records of each kind were drawn: VQ-880-G II at nadir and 600 m, a level known to 0.15 m, glints from none to
    five times the bottom's echo, reflectances 0.05 to 0.4. All land from 0.2 to 4 m is land, and 99 % of the bottoms
    from 0.3 to 4 m are found, none as land. Depth errors over stated errors have an rms of 0.85
    (`tests/unit/analysis/waveforms/test_echo_classes.py`). Within 0.1 m of the level, only the level separates land
    from water without a surface echo: probabilities are about one half.

    Parameters
    ----------
    waveforms, part, records
        All waveforms, and some of them, n.
    level
        What is known of the surface's time in these records.
    decay
        Typical rate of decay of a column [1/ns].
    detection
        How echoes are found.
    """
    width, last = waveforms.echo_fwhm_ns, records.time_ns.size
    apart, count = width / records.bin_ns, len(records.power)
    every = np.arange(count)

    def search(some: IntArray, after: FloatArray) -> DetectedEchoes:
        return find_echoes(
            records if some is every else records.part(some),
            width,
            threshold=detection.threshold,
            contrast=detection.contrast,
            earliest_ns=waveforms.quiet_until_ns,
            latest_ns=waveforms.latest_surface(part)[some],
            after_ns=after,
            event_height=waveforms.events(part)[some],
            waves=waveforms.focusing is not None,
            targets=detection.targets,
            tail=waveforms.template.share_behind(BEHIND_EDGE * width),
        )

    found = search(every, np.full(count, -np.inf))
    above = np.zeros(found.bins.shape, dtype=bool)

    def deviation() -> FloatArray:
        return (records.time_of(found.surface) - waveforms.echo_shape.peak_ns - level.time_ns) / level.stderr_ns

    lines = waveforms.lines_of(part)
    shallow = np.where(lines.off_nadir < GRAZING, _SHALLOW / lines.depth_per_ns, -np.inf)
    early = (deviation() < -_FAR - 0.5 * width / level.stderr_ns) & np.isfinite(shallow)
    following = _following(found, last)
    over = np.flatnonzero(
        (found.surface >= 0) & early & (following < last) & (following - found.surface > _APART * apart)
    )
    if over.size:
        again = search(over, records.time_of(found.surface[over]) + SEPARATE * width)
        found, above = _with_objects(found, over, again, detection.targets)
    at = np.rint((level.time_ns + waveforms.echo_shape.peak_ns - records.time_ns[0]) / records.bin_ns).astype(np.intp)
    found = _without_second_return(records, found, at, apart, 2 * shallow / records.bin_ns)
    following = _following(found, last)
    distance = (following - found.surface) / apart
    near = (distance < SEPARATE) | ((distance < _FAR_APART) & _is_weak(records, found.surface))
    # A first echo below the surface's level may be the bottom, and the second one its light that met it twice.
    second = (distance < _SECOND) | (deviation() > _FAR)
    near |= second & _is_weak_behind(records, found.surface, following)
    near &= following < last
    # A column between a weak surface and a bottom: its onset is more accurate than the level.
    rises = ~_is_weak_behind(records, found.surface, following, 1.0)
    until = np.asarray((following - found.surface) * records.bin_ns - 1.5 * width, np.float64)
    open_rows = np.flatnonzero(
        near & rises & (np.abs(deviation()) < _FAR) & (until > waveforms.tail_ns + _OPEN * width)
    )
    near[open_rows] = ~_has_column(
        records.part(open_rows), found.surface[open_rows], waveforms.tail_ns, until[open_rows, np.newaxis]
    )
    farthest = level.time_ns + waveforms.echo_shape.peak_ns + shallow + _FAR * level.stderr_ns
    # What follows a first echo far below the level is light that met it twice, however late.
    by_following = near & ~((deviation() > _FAR) & _is_weak_behind(records, found.surface, following))
    is_shallow = records.time_of(np.where(by_following, following, found.surface)) < farthest
    # An echo at the record's end may have a column behind it.
    left = records.time_ns[-1] - records.time_of(found.surface)
    behind = np.minimum(following, last - 1)
    counted = _with_events(records, waveforms.events(part))
    is_clear = ~_is_weak(counted, found.surface, _CLEAR) | (near & ~_is_weak(counted, behind, _CLEAR))
    is_whole = left > waveforms.tail_ns + _COLUMN_NS
    opaque = waveforms.fading.opaque
    if opaque:
        # Land or water; what follows a surface is in its echo.
        found, near = _surface_alone(found, above), np.zeros_like(near)
        tested = np.flatnonzero((found.surface >= 0) & np.isfinite(shallow))
    else:
        tested = np.flatnonzero((found.surface >= 0) & (near | (following == last)) & is_shallow & is_whole)
        at_level = np.abs(deviation()[tested]) < _FAR
        # Beyond light that has met a near bottom twice, or at the end of a record that is cut short.
        beyond = waveforms.tail_ns + np.clip(left[tested] - waveforms.tail_ns - _COLUMN_NS, 0, _FAR_APART * width)
        has_column = _has_column(records.part(tested), found.surface[tested], beyond[:, np.newaxis])
        has_column &= at_level & ~near[tested]
        tested = tested[~has_column]
    probability = np.where((found.bins >= 0).any(axis=0), 1.0, 0.0)
    few = (found.flags[-1] & int(EchoFlag.FEW_EVENTS)) > 0
    probability[few & (found.surface < 0) & (found.bins[-1] >= 0)] = FEW_EVENTS_CHANCE
    if not tested.size:
        return Decision(found, above, probability, tested)
    lines = lines.at(tested)
    priors = Priors(
        level.part(tested),
        IN_AIR * np.cos(lines.off_nadir),
        lines.depth_per_ns,
        waveforms.fading.clearest * waveforms.column_signal(part)[tested],
        decay,
        waveforms.onset,
        opaque,
        waveforms.level_stderr(part)[tested],
    )
    pulse, shape = waveforms.blurred_pulse, waveforms.echo_shape
    # The strongest of the first two.
    pair = np.stack([found.surface, np.where(near, following, found.surface)])[:, tested]
    heights = records.power[tested, pair]
    peak = pair[np.argmax(heights, axis=0), np.arange(len(tested))]
    extent = np.where(near[tested], (following[tested] - peak) * records.bin_ns + width, 0.0)
    first = first_echoes(counted.part(tested), peak, pulse, shape, width, priors, extent)
    land, sea, bottom = first.chance
    as_bottom = is_clear[tested] & (bottom > land) & (bottom > _LEAST_BOTTOM * sea)
    decided = as_bottom | (sea < np.maximum(land, bottom))
    probability[tested] = np.where(decided, np.maximum(land, bottom), sea)
    return _decided(Decision(found, above, probability, tested[decided], first.part(decided)), records, shape, width)


def _decided(one: Decision, records: Records, shape: EchoShape, width: float) -> Decision:
    """Return a decision with the bins and flags of its first echoes."""
    first, rows = one.first, one.rows
    assert first is not None
    bins, flags = one.found.bins.copy(), one.found.flags.copy()
    none, of_merged = int(EchoFlag.NO_ECHO), int(EchoFlag.MERGED)
    other = ~one.above[1:-1, rows]
    bins[1:-1, rows] = np.where(other, -1, bins[1:-1, rows])
    flags[1:-1, rows] = np.where(other, none, flags[1:-1, rows])
    merged = first.bottom.time_ns - first.surface_ns < SEPARATE * width
    for place, echo in ((0, first.surface), (-1, first.bottom)):
        exists = np.isfinite(echo.time_ns)
        at = np.rint((np.nan_to_num(echo.time_ns) + shape.peak_ns - records.time_ns[0]) / records.bin_ns)
        bins[place, rows] = np.where(exists, np.clip(at, 0, records.time_ns.size - 1), -1)
        flags[place, rows] = np.where(exists, of_merged * merged, none)
    return replace(one, found=DetectedEchoes(bins, flags))


def _with_events(records: Records, events: FloatArray) -> Records:
    """Return records whose noise is at least that of the events, of heights of shape (n,), that samples consist of.

    The stated noise is that of the mean light: where less than one event is expected, one would be certain light.
    """
    if not (events > 0).any():
        return records
    counted = np.sqrt(_OF_EVENTS * events[:, np.newaxis] * np.maximum(records.power, 0))
    return replace(records, noise=np.maximum(records.noise, counted))


def _surface_alone(found: DetectedEchoes, above: BoolArray) -> DetectedEchoes:
    """Return surfaces, and objects above the water, without echoes behind a surface."""
    kept = above.copy()
    kept[0] = True
    kept |= found.surface < 0
    flags = np.where(kept, found.flags & ~int(EchoFlag.MERGED), int(EchoFlag.NO_ECHO))
    return DetectedEchoes(np.where(kept, found.bins, -1), flags)


def _following(found: DetectedEchoes, last: int) -> IntArray:
    """Return the first bin of an echo behind the first one, `last` without any, shape (n,)."""
    return np.asarray(np.where(found.bins[1:] > found.surface, found.bins[1:], last).min(axis=0))


def _is_weak(records: Records, bins: IntArray, least: float = _WEAK) -> BoolArray:
    """Return which peaks are so weak that the time of an echo there is not well known."""
    rows, at = np.arange(len(bins)), np.maximum(bins, 0)
    return np.asarray(records.power[rows, at] < least * np.broadcast_to(records.noise, records.power.shape)[rows, at])


def _is_weak_behind(
    records: Records, first: IntArray, second: IntArray, most: FloatArray | float = _TWICE
) -> BoolArray:
    """Return which second peaks are so weak that they may be light which has met the bottom of the first one twice."""
    rows, last = np.arange(len(first)), records.time_ns.size - 1
    before, behind = (records.power[rows, np.clip(at, 0, last)] for at in (first, second))
    return np.asarray(behind < most * before)


def _without_second_return(
    records: Records, found: DetectedEchoes, level: IntArray, apart: float, shallow: FloatArray
) -> DetectedEchoes:
    """Return echoes without bottoms that are the light of a target which the surface has reflected, and so met twice.

    Totally reflected light arrives from 2.34 times the depth on, where it is brightest: at most 0.8 rho w/d of the
    bottom's echo per pulse width w and delay d. Without an echo the surface is in the bins `level`; for targets, within
    `shallow` bins after it.
    """
    bins, flags = found.bins.copy(), found.flags.copy()
    surface = np.where(bins[0] >= 0, bins[0], level)
    for target in range(1, len(bins) - 1):
        delay = bins[target] - surface
        most = np.minimum(_TWICE, _BRIGHTEST * apart / np.maximum(delay, 1))
        twice = (
            (bins[target] >= 0)
            & (delay < shallow)
            & (bins[-1] >= 0)
            & _is_weak_behind(records, bins[target], bins[-1], most)
        )
        twice &= (bins[-1] - surface > _RETURNS[0] * delay) & (bins[-1] - surface < _RETURNS[1] * delay)
        for mine, none in ((bins, -1), (flags, int(EchoFlag.NO_ECHO))):
            mine[-1] = np.where(twice, mine[target], mine[-1])
            mine[target] = np.where(twice, none, mine[target])
    return DetectedEchoes(bins, flags)


def _with_objects(
    found: DetectedEchoes, rows: IntArray, again: DetectedEchoes, most: int | None
) -> tuple[DetectedEchoes, BoolArray]:
    """Return echoes in which some rows start with objects, before echoes that were found again.

    Of `most` targets, the object takes the place of the last one.
    """
    targets = max(len(found.bins) - 2, len(again.bins) - 1) if most is None else most
    bins = np.full((targets + 2, found.bins.shape[1]), -1, dtype=np.intp)
    flags = np.full(bins.shape, int(EchoFlag.NO_ECHO))
    for mine, old, new in ((bins, found.bins, again.bins), (flags, found.flags, again.flags)):
        mine[: len(old) - 1], mine[-1] = old[:-1], old[-1]
        mine[:, rows] = -1 if mine is bins else int(EchoFlag.NO_ECHO)
        mine[0, rows], mine[1, rows], mine[-1, rows] = new[0], old[0][rows], new[-1]
        others = new[1:-1][: targets - 1]
        mine[2 : 2 + len(others), rows] = others
    above = np.zeros(bins.shape, dtype=bool)
    above[1, rows] = True
    return DetectedEchoes(bins, flags), above


def _has_column(
    records: Records, surface: IntArray, tail_ns: FloatArray | float, until_ns: FloatArray | float = np.inf
) -> BoolArray:
    """Return whether a column follows peaks, from a delay on that is longer than their tail, to another one [ns]."""
    delay = records.time_ns - records.time_ns[surface, np.newaxis]
    inside = (delay >= tail_ns) & (delay <= np.minimum(tail_ns + _COLUMN_NS, until_ns))
    total = np.sum(np.where(inside, records.power, 0.0), axis=1)
    return np.asarray(total > _COLUMN * error_of_sums(np.where(inside, records.noise, 0.0), None, records.shared))
