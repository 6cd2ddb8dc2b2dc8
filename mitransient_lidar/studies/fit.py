"""Fit of a scene's parameters to measured or simulated waveforms, by renders with exact derivatives."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.information import alignment
from mitransient_lidar.analysis.information.alignment import BANDWIDTH
from mitransient_lidar.analysis.information.cramer_rao import SCALE, TIME_OFFSET
from mitransient_lidar.analysis.information.fits import Model, WaveformFit
from mitransient_lidar.analysis.information.measured import measured, with_waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Instrument, Option, checked, positive_option
from mitransient_lidar.core.parameters.water import LAYERED_WATER
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading.catalogue import scene_parameters
from mitransient_lidar.loading.parameters import parameter_of, value_of, with_value
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.rendering.passes import MOST_PASSES, Progress, ProgressCallback
from mitransient_lidar.rendering.render import render
from mitransient_lidar.results.attributes import uninterrupted
from mitransient_lidar.results.waveform_files import FILE

if TYPE_CHECKING:
    import pandas as pd

logger = logging.getLogger(__name__)

_COARSE_PASSES = 4  # in renders that approach the solution
_FEWEST_PASSES, _MOST_PASSES = 16, 256  # that are chosen
#: Pass batches that give the errors by the model's Monte Carlo, besides those for each parameter: enough for their own
#: noise to matter little, and few because each is kept.
_BATCHES, _BATCHES_PER_PARAMETER, _MOST_BATCHES = 20, 4, 256
_WIDEST_BIN, _FINE_BIN = 0.4, 0.2  # widest bins of an interpolation, and finer ones, in pulse widths
_BIN_WIDTH = "bin_width_ns"
_LARGEST_RATIO = 0.1  # variance by the model's Monte Carlo over the waveform variance


@checked
def fit(
    source: xr.Dataset | str | os.PathLike[str],
    scene: Annotated[
        str | os.PathLike[str] | Model | None, Option("Name or XML file of the scene, by default the result's scene")
    ] = None,
    free: Annotated[
        Sequence[str], Option("Free scene parameters, and bandwidth_mhz for a receiver", form="NAME,NAME,...")
    ] = (),
    *,
    params: Mapping[str, Any] | None = None,
    instrument: Instrument = None,
    start: Annotated[
        Mapping[str, float] | None, Option("Start of a free parameter. Repeatable", form="NAME=VALUE")
    ] = None,
    bounds: Annotated[
        Mapping[str, tuple[float, float]] | None, Option("Bounds of a free parameter. Repeatable", form="NAME=LOW:HIGH")
    ] = None,
    free_scale: Annotated[
        bool | None, Option("Fit a scale factor, by default for CSV files alone", flag="--free-scale/--fixed-scale")
    ] = None,
    free_time: Annotated[
        bool | None, Option("Fit a time offset, by default for CSV files alone", flag="--free-time/--fixed-time")
    ] = None,
    noise: Annotated[
        float | None, positive_option("Standard deviation of every sample, in the waveforms' unit")
    ] = None,
    receiver: Annotated[
        str | os.PathLike[str] | ReceiverChain | None,
        Option(
            "Receiver whose response and noise the model gets: a preset, an instrument or a .toml file. By default "
            "the receiver that the signal names"
        ),
    ] = None,
    scale_errors: Annotated[bool, Option("Multiply the covariance by the reduced chi-squared")] = False,
    passes: Annotated[
        int | None, Option("Passes per render, by default as many as the waveform errors need", 2, MOST_PASSES)
    ] = None,
    max_time: Annotated[
        float | None, positive_option("Try no step after this many seconds, so that the fit may not converge")
    ] = None,
    seed: Annotated[
        int | None, Option("Seed of all renders, by default 1, or for a result its own plus 1", 0, 2**53)
    ] = None,
    most_renders: Annotated[int, Option("Renders after which the fit ends without convergence", 2, 10_000)] = 60,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Fit scene parameters to waveforms by weighted nonlinear least squares.

    Parameters
    ----------
    source
        A result, a recorded signal, or a CSV file; see `analysis.information.measured.measured`.
    scene
        Name or path of the scene, by default the result's; or a function that returns a render with derivatives for
        values of the free parameters (`analysis.information.fits.WaveformFit`).
    free
        Names of the free parameters, such as ``attenuation``, ``attenuation[1]`` for the second layer, or
        ``bottom_reflectance``; and ``bandwidth_mhz``, the half-power frequency of a single-pole receiver [MHz].
    start
        Starts of free parameters, by default their values in the scene; also for ``scale`` and ``time_offset_ns``.
    bounds
        Lowest and highest values of free parameters, by default their physical ranges; an attenuation with a fixed
        scattering begins there, and a scattering ends at a fixed attenuation.
    free_scale, free_time
        Whether the scale and the time offset [ns] of the waveforms are free parameters, by default only for a CSV file,
        whose unit and time zero are unknown.
    passes
        Passes per render, 2 to 10^9; by default 16 to 256: as many as make the median variance by the model's Monte
        Carlo a tenth of the waveforms' variance.
    max_time
        Time after which no step is tried [s], above 0: the fit ends at the last step, without convergence and with a
        warning. The start is always rendered.

    Returns
    -------
    xarray.Dataset
        See `analysis.information.fits.WaveformFit.run`; with the attributes ``scene``, ``passes`` and ``seed`` of a
        rendered model.

    Raises
    ------
    UserError
        If the waveforms, the scene, a parameter or an option is invalid; or the seed is the result's, whose noise the
        model would repeat.
    """
    limit, began = max_time or math.inf, time.perf_counter()
    names = _names(free)
    if unknown := [name for name in start or {} if name not in (*names, SCALE, TIME_OFFSET)]:
        raise UserError(f"start of {unknown[0]}: it is not one of the free parameters {', '.join(names)}")
    source = with_waveforms(source)
    found = measured(source, noise=noise, receiver=receiver)
    if BANDWIDTH in names:
        if found.receiver is not None:
            raise UserError(f"free = {BANDWIDTH} and a receiver, which has its own response, are alternatives")
        start = {BANDWIDTH: alignment.BANDWIDTH_START, **(start or {})}
        bounds = {BANDWIDTH: alignment.BANDWIDTH_BOUNDS, **(bounds or {})}
    model = None
    if callable(scene):
        if missing := [name for name in names if name not in (start or {})]:
            raise UserError(f"start of {missing[0]} is missing: a model that is a function needs all starts")
        render_at: Model = scene
        starts = {name: (start or {})[name] for name in names} | dict(start or {})
    else:
        attributes = source.attrs if isinstance(source, xr.Dataset) else {}
        render_at = model = _RenderedModel(
            _scene(scene, attributes),
            dict(params or {}),
            instrument,
            [name for name in names if name != BANDWIDTH],
            min(passes or _FEWEST_PASSES, _COARSE_PASSES),
            _seed(seed, attributes),
            progress,
            not found.calibrated if free_time is None else free_time,
        )
        starts = {**model.starts(start or {}), **(start or {})}
        bounds = {**model.bounds(), **(bounds or {})}

    def light() -> Model:
        return alignment.behind_bandwidth(render_at) if BANDWIDTH in names else render_at

    problem = WaveformFit(found, light(), starts, bounds, free_scale=free_scale, free_time=free_time)
    problem.approach(most_renders=most_renders, until=began + limit)
    if model is not None and time.perf_counter() - began < limit and not problem.interrupted:
        model.passes = passes or _passes(problem.noise_ratio())
        problem.forget(light())
    fitted = problem.run(most_renders=most_renders, until=began + limit, scale_errors=scale_errors)
    if not fitted.attrs["converged"] and time.perf_counter() - began >= limit:
        logger.warning("max_time = %g s ended the fit after %d renders, before convergence", limit, problem.renders)
    if model is None:
        return fitted
    return fitted.assign_attrs({"scene": model.name, "passes": model.passes, "seed": model.seed})


def _passes(ratio: float) -> int:
    """Return the passes of a render from the variance by Monte Carlo in coarse ones over the waveforms' variance."""
    needed = math.ceil(_COARSE_PASSES * ratio / _LARGEST_RATIO)
    if needed > _MOST_PASSES:
        logger.warning(
            "a Monte Carlo error small against that of the waveforms takes %d passes, %d are rendered: passes = %d "
            "would give smaller errors",
            needed,
            _MOST_PASSES,
            needed,
        )
    return min(max(needed, _FEWEST_PASSES), _MOST_PASSES)


@dataclass
class _RenderedModel:
    """Scene renders for values of its free parameters, all with the same random numbers.

    Where light is interpolated `between_bins` that are too wide for it, the scene is rendered with narrower ones.
    """

    scene: str | os.PathLike[str] | SceneSource
    params: dict[str, Any]
    instrument: str | None
    names: list[str]
    passes: int
    seed: int
    progress: ProgressCallback | None
    between_bins: bool

    def __post_init__(self) -> None:
        if isinstance(self.scene, SceneSource):
            self.name, own = self.scene.name, self.scene.values
        else:
            self.name, own = Path(self.scene).stem, scene_parameters(self.scene, by_id=True)
        self.texts = {**own, **{name: str(value) for name, value in self.params.items()}}
        self.done, self.began = 0, time.perf_counter()

    def __call__(self, values: Mapping[str, float]) -> xr.Dataset:
        """Render the scene with other values of the free parameters; a Ctrl-C ends the fit."""
        dataset = self._render(values)
        if self.done == 0 and self.between_bins and (width := _narrower_bins(dataset)):
            if _BIN_WIDTH in self.texts and _BIN_WIDTH not in self.params:
                self.params[_BIN_WIDTH] = width
                logger.info("the model has bins of %.3g ns, so that its light is known between them", width)
                dataset = self._render(values)
            else:
                logger.warning(
                    "the bins of the model are too wide for its pulse: times between them are interpolated, set "
                    "bin_width_ns to %.2g or less",
                    width,
                )
        self.done += 1
        if self.progress is not None:
            self.progress(Progress(self.done, None, unit="render", elapsed_s=time.perf_counter() - self.began))
        return dataset

    def _render(self, values: Mapping[str, float]) -> xr.Dataset:
        """Render the scene with other values of the free parameters; raise KeyboardInterrupt after a Ctrl-C."""
        dataset: xr.Dataset = render(
            self.scene,
            params=self.with_values(values),
            instrument=self.instrument,
            passes=self.passes,
            seed=self.seed,
            derivatives=self.names,
            batches=min(self.passes, _MOST_BATCHES, _BATCHES + _BATCHES_PER_PARAMETER * len(self.names)),
        )
        return uninterrupted(dataset)

    def starts(self, given: Mapping[str, float]) -> dict[str, float]:
        """Return the starts of the free parameters, by default their values in the scene."""
        return {name: given.get(name, value_of(self.texts, name)) for name in self.names}

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Return the bounds that fixed coefficients set: a layer attenuates at least as much as it scatters."""
        found = {}
        for name in self.names:
            base = parameter_of(name)
            fixed = {"attenuation": "scattering", "scattering": "attenuation"}.get(base, "")
            other = fixed + name.removeprefix(base)
            if not fixed or other in self.names:
                continue
            # Coefficients may also come from a water by name, or from layers that the name does not distinguish.
            with contextlib.suppress(UserError):
                value = value_of(self.texts, other)
                found[name] = (value, LAYERED_WATER[base].high) if base == "attenuation" else (0.0, value)
        return found

    def with_values(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Return the scene parameters with other values, layer values in their list."""
        texts = self.texts
        for name, value in values.items():
            texts = with_value(texts, name, value)
        return {**self.params, **{parameter_of(name): texts[parameter_of(name)] for name in values}}


def _narrower_bins(dataset: xr.Dataset) -> float:
    """Return a width of bins [ns] between which light is known, 0 where it is: splines err by less than its noise."""
    width, pulse = (float(dataset.attrs.get(name, math.nan)) for name in (_BIN_WIDTH, "pulse_fwhm_ns"))
    return float(f"{_FINE_BIN * pulse:.2g}") if width > _WIDEST_BIN * pulse else 0.0


def _names(free: Sequence[str]) -> list[str]:
    """Return the names of the free parameters, each once."""
    names = [free] if isinstance(free, str) else list(free)
    if not names or not all(names):
        raise UserError(f"free = {shown(names)} must name one or more parameters of the scene")
    if twice := [name for name in names if names.count(name) > 1]:
        raise UserError(f"free = {shown(names)} names {twice[0]} twice")
    return names


def _scene(scene: str | os.PathLike[str] | None, attributes: Mapping[str, Any]) -> str | os.PathLike[str] | SceneSource:
    """Return the scene, or a result's scene."""
    if scene is not None:
        return scene
    if not attributes or FILE in attributes:
        raise UserError("scene is missing: waveforms of a table do not hold theirs")
    return SceneSource.from_attributes(attributes)


def _seed(seed: int | None, attributes: Mapping[str, Any]) -> int:
    """Return the seed of the renders, different from a result's seed."""
    own = attributes.get("seed")
    if seed is None:
        return 1 if own is None else int(own) + 1
    if own is not None and seed == own:
        raise UserError(f"seed = {seed} is that of the result: the model would repeat its noise, choose another seed")
    return seed


def describe_fit(fitted: xr.Dataset) -> list[str]:
    """Return table lines for a fit: each parameter's value, standard error and start, and the fit's quality."""
    columns = (("parameter", "<24"), ("value", ">13.6g"), ("error", ">11.3g"), ("start", ">13.6g"), ("  unit", ""))
    ends = np.where(fitted["at_bound"].values, " (at its bound)", "")
    units = [f"  {unit}{end}" for unit, end in zip(fitted["parameter_units"].values, ends, strict=True)]
    error = [value if np.isfinite(value) else "unknown" for value in fitted["stderr"].values]
    cells = (fitted["parameter"].values, fitted["value"].values, error, fitted["start"].values, units)
    lines = table_lines(columns, zip(*cells, strict=True))
    chi = fitted.attrs
    text = f"chi-squared {chi['chi_squared']:.4g}, expected {chi['expected']:.4g}"
    if np.isfinite(chi["probability"]):
        text += f"; a larger one has the probability {chi['probability']:.3g}"
    return [*lines, text, f"{chi['renders']} renders", *chi["messages"]]


def parameter_frame(fitted: xr.Dataset) -> pd.DataFrame:
    """Return the table of a fit's parameters, as for a CSV file."""
    columns = ("parameter_units", "value", "stderr", "stderr_by_model", "start", "low", "high", "at_bound")
    frame = fitted.reset_coords()[[*columns]].to_dataframe().reset_index()[["parameter", *columns]]
    return frame.rename(columns={"parameter_units": "unit"})
