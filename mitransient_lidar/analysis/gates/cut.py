"""Gates cut from a result's waveforms."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, shown
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.results.gate_stack import add_gate_derivatives, build_gates, check_train
from mitransient_lidar.results.geometry import optional_number, pulse_of
from mitransient_lidar.results.sum_errors import SumErrors

_LOG = logging.getLogger(__name__)


def cut_gates(dataset: results.Given, train: GateTrain) -> xr.Dataset:
    """Return the gate stack of a result with ``waveform`` and ``waveform_stderr`` [W].

    Raises
    ------
    UserError
        If the dataset has no waveforms, the train ends before the surface echo, or a gate is not within the record.

    Notes
    -----
    A gate's energy is the sum over bins of mean power times bin width times the gate's exact mean over the bin. The
    errors of bins are correlated: the standard error follows from bin errors and their ``error_correlation``, measured
    over the render's passes. Without it, as in a result from an EXR file, it is the quadrature sum times the median
    error inflation for a sum over as many bins. The attributes ``error_inflation_bins`` and ``error_inflation`` give
    the inflation. It is linear in the logarithm of the bin number, and beyond the last one proportional to the square
    root. The error is at most the sum of the errors, which is used if nothing is known. A gate with weights w is
    equivalent to (sum w)^2 / sum w^2 bins. Derivatives in a result are cut in the same way, with the waveform's
    correlation: ``gate_energy_derivative`` and its standard error, over ``parameter`` too. For gates that are narrower
    than the bins a warning states the largest error, `GateTrain.cutting_error`; gates in a film are exact.
    """
    dataset = results.dataset_of("dataset", dataset, "waveforms")
    if "waveform_stderr" not in dataset:
        raise UserError("the dataset has no waveform_stderr, and gates need the errors of the waveforms")
    if not isinstance(train, GateTrain):
        raise UserError(f"train = {shown(train)} must be a GateTrain, which has the gates")
    dims, time = results.record_dims(dataset, "waveform"), results.time_axis(dataset)
    check_train(train, dataset.attrs, time)
    _warn_of_narrow_gates(train, dataset.attrs, time.bin_width_ns)
    errors = SumErrors.of(dataset)
    if errors is None:
        _LOG.info("the result has no error_inflation: the errors of the gates are upper bounds")
    energy, stderr = _cut(dataset, "waveform", dims, train, errors)
    # The result's own gates are replaced.
    coords = {name: one for name, one in dataset.coords.items() if "gate" not in one.dims}
    stack = build_gates(energy, stderr, train, coords=coords, attributes=dataset.attrs)
    if "waveform_derivative" not in dataset:
        return stack
    return add_gate_derivatives(stack, *_cut(dataset, "waveform_derivative", ("parameter", *dims), train, errors))


def _warn_of_narrow_gates(train: GateTrain, attributes: Mapping[str, Any], bin_width_ns: float) -> None:
    """Warn about gates that are narrower than the bins."""
    if train.width_ns >= bin_width_ns:
        return
    response = optional_number(attributes, "response_time_ns") or 0.0
    try:
        error = f"{100 * train.cutting_error(pulse_of(attributes), response, bin_width_ns):.0f} %"
    except UserError:
        error = "an unknown part"
    _LOG.warning(
        "gates of %g ns are narrower than the bins of %g ns: the energy of an echo may be wrong by up to %s of the "
        "largest in a gate; render with narrower bins, or with these gates in the film",
        train.width_ns,
        bin_width_ns,
        error,
    )


def _cut(
    dataset: xr.Dataset,
    name: str,
    dims: tuple[str, ...],
    train: GateTrain,
    errors: SumErrors | None,
) -> tuple[FloatArray, FloatArray]:
    """Return energies in gates [J] of a power, or its derivatives, and their standard errors, with gates last."""
    time = results.time_axis(dataset)
    power, deviation = (dataset[one].transpose(*dims).values for one in (name, f"{name}_stderr"))
    energy = np.zeros((*power.shape[:-1], train.count))
    stderr = np.zeros_like(energy)
    for gate in range(train.count):
        first, weights = train.gate_bins(gate, time.start_ns, time.bin_width_ns, time.bin_count)
        # Only the bins of the gate: a NaN in another bin must not spread to it.
        inside = slice(first, first + weights.size)
        energy[..., gate] = power[..., inside] @ weights
        own = deviation[..., inside]
        stderr[..., gate] = own @ weights if errors is None else errors.of_sum(own, weights, first)
    joules = train.pulses * time.bin_width_ns * 1e-9
    return joules * energy, joules * stderr
