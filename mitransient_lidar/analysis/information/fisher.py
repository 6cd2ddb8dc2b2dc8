"""Fisher information in a receiver's record about scene parameters."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.linalg import solve_triangular

from mitransient_lidar import results
from mitransient_lidar.analysis.information.cramer_rao import Bounds, bounds
from mitransient_lidar.analysis.information.errors import jackknife_error
from mitransient_lidar.analysis.receiver import PixelChain, pixel_chains
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.receiver_files import ReceiverChannels, Setting
from mitransient_lidar.physics.receiver.sample_moments import sample_moments
from mitransient_lidar.results.attributes import label

_LOG = logging.getLogger(__name__)

#: Probability of saturation above which a sample counts as lost. Below it, a sample that is normally distributed and
#: clipped on one side keeps more than 99 % of its information about the mean.
SATURATED = 0.05

#: Quantities that may be unknown besides the parameters of the scene, with their units.
NUISANCES = {"time_offset": "ns", "scale": "1"}

_JITTER = 1e-10  # of the variance, added where noise is correlated so much that the matrix is singular
_NOTED = 0.01  # share of the information by the render's own noise from which on it is noted
_COPIED = ("scene", "instrument", "field_of_view_mrad", "layout", "passes", "seed")


class _Gram(NamedTuple):
    """Products of derivatives under the noise, by mean and by covariance, over (render, parameter) twice."""

    mean: FloatArray
    covariance: FloatArray

    def information(self, renders: npt.NDArray[np.int64], part: str = "") -> FloatArray:
        """Return the information from some renders, unbiased from two on; `part` names one of the parts."""
        gram = getattr(self, part) if part else self.mean + self.covariance
        own = gram[renders][:, :, renders]
        if len(renders) == 1:
            return np.asarray(own[0, :, 0])
        # Products of different renders: each render's errors would add their variance to its own square.
        all_pairs, same = own.sum(axis=(0, 2)), np.einsum("kakb->ab", own)
        found = (all_pairs - same) / (len(renders) * (len(renders) - 1))
        return np.asarray(0.5 * (found + found.T))


def fisher_information(
    dataset: xr.Dataset | Sequence[xr.Dataset],
    chain: ReceiverChannels | ReceiverChain | str | os.PathLike[str] | None = None,
    background_power: npt.ArrayLike | xr.DataArray = 0.0,
    *,
    gain: Setting | None = None,
    optical_density: Setting | None = None,
    nuisances: Mapping[str, float] | None = None,
) -> xr.Dataset:
    """Return the Fisher information in one shot's record about scene parameters, and Cramer-Rao bounds.

    Raises `UserError` if a dataset has no derivatives, renders differ, no sample has both signal and noise, a nuisance
    is unknown, or as for `detect_waveforms`.

    `dataset`: results of `render` with derivatives: ``waveform`` [W] over (pixel, time) or (row, column, time), and
    ``waveform_derivative`` [W per unit of the parameter] over parameter and the same dimensions. Several are
    independent renders of one scene, whose noise then does not count as information. `chain`, `background_power`,
    `gain`, `optical_density`: as for `analysis.receiver.detect_waveforms`. `nuisances`: unknown quantities besides the
    parameters, with the standard deviation to which each is known, above 0 and infinite for not at all: ``time_offset``
    [ns] in all pixels and ``scale`` [1] of the laser light.

    Result: over ``parameter``, the derivatives' parameters and then the nuisances: ``bound``, the smallest standard
    deviation of an unbiased estimate from one shot with all parameters unknown, in the parameter's unit.
    ``bound_stderr`` is its error by render noise (NaN for less than three renders), and ``bound_known`` the bound with
    all others known. ``variance_share`` is the share of the information that is in the sample variance.
    ``monte_carlo_share`` is the addition by the noise of all renders together, relative to the information (see below).
    Over (parameter, other_parameter): ``information`` and ``correlation`` of the estimates. Over (render, parameter),
    from three renders on: ``bound_left_out``, without one of the renders. Per pixel ``lost_samples``, the share of
    samples that saturate. Coordinates ``parameter_value``, ``parameter_units``, ``parameter_method`` and ``prior`` (a
    nuisance's standard deviation, infinite elsewhere). The attribute ``remarks`` has sentences on parameters that the
    record does not determine, one per line.

    For normal samples of mean m and covariance C, with derivatives m_a and C_a by the parameter a,

        F_ab = m_a C^-1 m_b + tr(C^-1 C_a C^-1 C_b)/2

    (S. M. Kay, Fundamentals of Statistical Signal Processing, volume 1, 1993, equation 3.31). C contains shot noise and
    amplifier noise, correlated by the bandwidth, and rounding noise (`sample_moments`). A logarithm loses nothing, so
    that samples count before it. Samples that saturate in more than 5 % of the shots are lost.

    Electrons and counts without an amplifier have F_ab = m_a C^-1 m_b, exact for Poisson counts, m_a m_b/m. For others
    this is a lower bound of the information (M. Stein, A. Mezghani and J. A. Nossek, IEEE Signal Process. Lett. 21, 796
    (2014), doi:10.1109/LSP.2014.2316008). After an amplifier the second term assumes normal samples, which a few
    photoelectrons are not: ``variance_share`` states how much depends on it. Samples without any noise are left out.

    A nuisance with a standard deviation s adds 1/s^2 to its diagonal (H. L. Van Trees, Detection, Estimation, and
    Modulation Theory, part I, 1968, section 2.4). The time offset's derivative is taken from differences of
    neighbouring bins, which should be narrow against the pulse.

    Monte Carlo errors in derivatives add their variance divided by the sample variance to F. With several renders, only
    products of different ones are averaged, which is free of it; ``monte_carlo_share`` is the addition by all products.
    With a single one, it is estimated from ``waveform_derivative_stderr``, without the receiver's response, and not
    removed. Bounds from a noisy F are themselves biased a little, by their squared relative error.
    """
    renders = [dataset] if isinstance(dataset, xr.Dataset) else list(dataset)
    dims = _check(renders)
    prior = priors(nuisances or {})
    mean = renders[0].assign(waveform=sum(one["waveform"].transpose(*dims) for one in renders) / len(renders))
    receivers = pixel_chains(mean, chain, background_power, gain=gain, optical_density=optical_density)
    axis = results.time_axis(mean)
    light = mean["waveform"].values.reshape(-1, axis.bin_count)
    changes = np.stack([_directions(one, dims, prior, axis.bin_width_ns) for one in renders])
    errors = [_flat(one["waveform_derivative_stderr"], dims) for one in renders if len(renders) == 1]
    names = [*map(str, renders[0]["parameter"].values), *prior]
    gram, lost, added = _products(receivers, light, changes, axis.bin_width_ns, errors)

    known = np.array([*np.zeros(len(names) - len(prior)), *(1 / one**2 for one in prior.values())])
    every = np.arange(len(renders))
    information = gram.information(every) + np.diag(known)
    found = bounds(information, names)
    without = np.empty((0, len(names)))
    if every.size > 2:
        left = [bounds(gram.information(np.delete(every, one)) + np.diag(known), names) for one in every]
        without = np.array([one.bound for one in left])
        error = jackknife_error(np.array([one.smallest for one in left]))
        if 0 <= found.smallest <= 2 * error:  # a negative eigenvalue has been named already
            found.remarks.append(
                f"the smallest eigenvalue of the scaled information, {found.smallest:.2g}, is within twice its error "
                f"by the render, {error:.2g}: render more passes"
            )
    with np.errstate(divide="ignore", invalid="ignore"):
        diagonal = np.diagonal(information) - known
        if every.size > 1:
            own = np.einsum("kaka->a", gram.mean + gram.covariance) / every.size
            added = (own - diagonal) / every.size
        shares = {
            "variance_share": np.diagonal(gram.information(every, "covariance")) / diagonal,
            "monte_carlo_share": added / diagonal,
        }
    verb, after = ("adds", ": its bound is too low") if every.size == 1 else ("would add", ", which is removed")
    of_noise = [
        f"the noise of the render {verb} {100 * share:.3g} % to the information about {name}{after}"
        for name, share in zip(names, shares["monte_carlo_share"], strict=True)
        if math.isfinite(share) and share > _NOTED
    ]
    remarks = [*found.remarks, *of_noise]
    for remark in found.remarks:
        _LOG.warning("%s", remark)
    return _labelled(renders[0], names, prior, found, information, without, shares, lost, remarks, dims)


def _check(renders: Sequence[xr.Dataset]) -> tuple[str, ...]:
    """Return the dimensions of the waveforms; refuse datasets without derivatives, and renders that differ."""
    if not renders:
        raise UserError("dataset = [] must hold at least one result")
    for one in renders:
        dims = results.record_dims(one, "waveform")
        if "waveform_derivative" not in one or "parameter" not in one.coords:
            raise UserError("the dataset has no waveform_derivative: render it with derivatives")
        wanted = ("parameter", *dims)
        if set(one["waveform_derivative"].dims) != set(wanted):
            raise UserError(f"waveform_derivative has the dimensions {one['waveform_derivative'].dims}; not {wanted}")
        values = one["waveform_derivative"].values
        if not np.isfinite(values).all():
            count = np.count_nonzero(~np.isfinite(values))
            raise UserError(f"waveform_derivative has {count} values that are not finite; render again")
        for name in ("time", "parameter", "parameter_value", "angle_x", "angle_y"):
            same = name not in one.coords or np.array_equal(one[name].values, renders[0][name].values)
            if not same:
                raise UserError(f"the renders differ in {name}: they must be of one scene and one record")
    return dims


def priors(nuisances: Mapping[str, float]) -> dict[str, float]:
    """Return the standard deviations to which nuisances are known, as numbers.

    Raises `UserError` if a name is not in `NUISANCES`, or a number not above 0.
    """
    for name, known in nuisances.items():
        if name not in NUISANCES:
            raise UserError(f"nuisance = {name!r} must be one of {', '.join(NUISANCES)}")
        if not (isinstance(known, int | float) and known > 0):
            raise UserError(f"{name} = {known} must be a standard deviation above 0, or infinite")
    return {name: float(known) for name, known in nuisances.items()}


def _flat(values: xr.DataArray, dims: tuple[str, ...]) -> FloatArray:
    """Return values over (parameter, pixel, time), pixels of an imager in row-major order."""
    array = values.transpose("parameter", *dims).values
    return np.asarray(array.reshape(len(array), -1, array.shape[-1]), dtype=np.float64)


def _directions(
    one: xr.Dataset, dims: tuple[str, ...], nuisances: Mapping[str, float], bin_width_ns: float
) -> FloatArray:
    """Return derivatives of the waveform by parameters and nuisances, shape (parameter, pixel, time)."""
    light = one["waveform"].transpose(*dims).values
    light = light.reshape(-1, light.shape[-1])
    if "time_offset" in nuisances and light.shape[-1] < 2:
        raise UserError("time_offset needs a record of at least two bins")
    extra = [light if name == "scale" else -np.gradient(light, bin_width_ns, axis=-1) for name in nuisances]
    return np.concatenate([_flat(one["waveform_derivative"], dims), *(values[None] for values in extra)])


def _products(
    receivers: Sequence[PixelChain],
    light: FloatArray,
    changes: FloatArray,
    bin_width_ns: float,
    errors: Sequence[FloatArray],
) -> tuple[_Gram, FloatArray, FloatArray]:
    """Return derivative products, each pixel's share of lost samples, and the information by errors.

    `changes` have the shape (render, parameter, pixel, time); `errors` contains a single render's standard errors, or
    nothing.
    """
    renders, count = changes.shape[:2]
    sums = np.zeros((2, renders * count, renders * count))
    lost, added, used = np.zeros(len(light)), np.zeros(count), 0
    for number, (receiver, power) in enumerate(zip(receivers, light, strict=True)):
        filtered = receiver.transmittance * changes[:, :, number].reshape(renders * count, -1)
        own = receiver.transmittance * power, filtered, bin_width_ns, receiver.transmittance * receiver.background
        moments = sample_moments(receiver.chain, *own)
        variance = np.diagonal(moments.covariance)
        kept = (moments.saturation <= SATURATED) & (variance > 0)
        lost[number] = float(np.mean(moments.saturation > SATURATED))
        used += int(np.count_nonzero(kept & np.any(moments.mean_derivatives != 0, axis=0)))
        root = _root(moments.covariance[np.ix_(kept, kept)])
        whitened = solve_triangular(root, moments.mean_derivatives[:, kept].T, lower=True).T
        sums[0] += whitened @ whitened.T
        if receiver.chain.amplifier is not None:
            flat = np.stack([_whitened(root, one[np.ix_(kept, kept)]) for one in moments.covariance_derivatives])
            sums[1] += 0.5 * (flat @ flat.T)
        if errors:
            stride = receiver.chain.stride(bin_width_ns)
            # The receiver's response is left out: a bin changes the sample at its own time alone.
            steady = np.ones((1, power.size))
            per_watt = sample_moments(receiver.chain, own[0], steady, *own[2:]).mean_derivatives[0]
            error = receiver.transmittance * errors[0][:, number, ::stride][:, kept]
            added[: len(error)] += ((error * per_watt[kept]) ** 2 / variance[kept]).sum(axis=1)
    if used == 0:
        raise UserError("no sample has both a derivative and noise without saturation: the record holds no information")
    shape = renders, count, renders, count
    return _Gram(*sums.reshape(2, *shape)), lost, added


def _root(covariance: FloatArray) -> FloatArray:
    """Return a covariance's Cholesky factor."""
    return np.asarray(np.linalg.cholesky(covariance + _JITTER * np.diag(np.diagonal(covariance))))


def _whitened(root: FloatArray, change: FloatArray) -> FloatArray:
    """Return a covariance change between the covariance's inverse roots, as a vector."""
    half = solve_triangular(root, change, lower=True)
    return np.asarray(solve_triangular(root, half.T, lower=True).ravel())


def _labelled(
    first: xr.Dataset,
    names: Sequence[str],
    prior: Mapping[str, float],
    found: Bounds,
    information: FloatArray,
    without: FloatArray,
    shares: Mapping[str, FloatArray],
    lost: FloatArray,
    remarks: Sequence[str],
    dims: tuple[str, ...],
) -> xr.Dataset:
    """Return the dataset for `fisher_information`."""
    own = len(names) - len(prior)
    stderr = [jackknife_error(one) if len(one) and np.isfinite(one).all() else math.nan for one in without.T]
    pixels = tuple(dim for dim in dims if dim != "time")
    over, both = ("parameter",), ("parameter", "other_parameter")
    data: dict[str, Any] = {
        "bound": (over, found.bound),
        "bound_stderr": (over, stderr),
        "bound_known": (over, found.bound_known),
        "variance_share": (over, shares["variance_share"]),
        "monte_carlo_share": (over, shares["monte_carlo_share"]),
        "information": (both, information),
        "correlation": (both, found.correlation),
        "lost_samples": (pixels, lost.reshape([first.sizes[dim] for dim in pixels])),
    }
    if len(without):
        data["bound_left_out"] = (("render", "parameter"), without)
    extra = {"parameter_value": 0.0, "parameter_units": "", "parameter_method": "score"}
    values = {
        name: [*(first[name].values.tolist() if name in first.coords else [default] * own)]
        for name, default in extra.items()
    }
    values["parameter_value"] += [1.0 if name == "scale" else 0.0 for name in prior]
    values["parameter_units"] += [NUISANCES[name] for name in prior]
    values["parameter_method"] += ["differences of bins" if name == "time_offset" else "score" for name in prior]
    coords: dict[str, Any] = {
        "parameter": ("parameter", list(names)),
        "other_parameter": ("other_parameter", list(names)),
        "prior": ("parameter", [*[math.inf] * own, *prior.values()]),
        **{name: ("parameter", value) for name, value in values.items()},
        **{str(name): first[name] for name in ("pixel", "angle_x", "angle_y") if name in first.coords},
    }
    kept = {name: first.attrs[name] for name in _COPIED if name in first.attrs}
    return label(xr.Dataset(data, coords, {**kept, "remarks": "\n".join(remarks)}))
