"""Renders a lidar scene to an accuracy, or a result again."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import xarray

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Infrared, Instrument, Option, SceneOrResult, Sensor, checked
from mitransient_lidar.loading.catalogue import with_infrared
from mitransient_lidar.loading.scenes import LoadedScene, choose_integrator, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.rendering import again
from mitransient_lidar.rendering import passes as engine
from mitransient_lidar.rendering.accumulators import choose_accumulator, share_of_pass
from mitransient_lidar.rendering.accuracy import ErrorWindow
from mitransient_lidar.rendering.derivatives import Differences, path_parameters, perturbations
from mitransient_lidar.rendering.describe import describe_scene, with_lines_of_sight
from mitransient_lidar.rendering.pass_size import describe_cost, fit_to_time
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.passive import render_passive
from mitransient_lidar.rendering.scene_checks import check_scene
from mitransient_lidar.rendering.shots.frames import render_frames
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.results.attributes import join, split, uninterrupted
from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses, check_solids
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import find_lidar_scene

logger = logging.getLogger(__name__)

#: Default render ends without and with gates.
DEFAULT_GOAL = engine.Goal(target_error=0.03, max_time=300.0)
DEFAULT_GATE_GOAL = engine.Goal(target_error=0.1, max_time=60.0)


@checked
@alone
def render(
    scene: SceneOrResult,
    params: Mapping[str, Any] | None = None,
    *,
    instrument: Instrument = None,
    infrared: Infrared = False,
    sensor: Sensor = None,
    integrator: Annotated[Any, Option("Integrator, by default the scene's")] = None,
    target_error: engine.TargetError = None,
    target_quantile: engine.TargetQuantile = None,
    max_time: engine.MaxTime = None,
    passes: engine.Passes = None,
    seed: engine.RenderSeed = None,
    max_memory: engine.MaxMemory = None,
    pass_share: float | None = None,
    components: engine.Components = None,
    derivatives: engine.Derivatives = None,
    batches: engine.Batches = None,
    smooth: engine.Smooth = None,
    light: engine.Light = None,
    variant: engine.Variant = None,
    progress: ProgressCallback | None = None,
    **others: Any,
) -> xarray.Dataset:
    """Render a lidar scene in independent passes until it is accurate enough, or a result again.

    Parameters
    ----------
    scene
        Name of a shipped scene, path of a Mitsuba XML file, dict for ``mitsuba.load_dict``, a loaded scene, a scene
        record, or a session. A result (a dataset, or its EXR or NetCDF file) is rendered again with its own options
        unless others are given. See `render_again`.
    params
        Values for parameters in an XML scene and its plugins; they have priority over an instrument's.
    infrared
        Whether to also render the instrument's infrared channel, at the same place; it takes a render of its own. See
        `loading.catalogue.with_infrared` for the parameters, and `results.attributes`.
    integrator
        Name or dict of an integrator plugin, or an integrator; by default the scene's.
    target_error
        Relative standard error, greater than 0, at most 1, that ends the render after at least 8 passes. 95 % of the
        bins of lit pixels must have reached it, from the surface echo to the end of the bottom echo. With gates, 95 %
        of the gates must have reached it, in the median over their lit pixels.
    max_time
        Longest time for the passes [s], greater than 0. At least two passes are rendered; where full ones would take
        longer, with fewer paths (the attribute ``pass_share``).
    seed
        Integer from 0 to 2^53, 0 by default; the same seed gives the same result on the same machine.
    max_memory
        Memory for histograms, means and errors [GB], greater than 0; 2 by default. If a scene with gates exceeds it,
        only the gates are kept, with a warning. For images it is the whole of the process, and passes render tiles of
        pixels where these alone fit.
    pass_share
        Share of a full pass's paths in each pass, 1/512 to 1; by default 1, or less where `max_time` needs it.
    components
        Whether to separate the light by its origin, by default not: ``surface``, ``water``, and the id of each solid,
        such as ``bottom``. The origin is the last solid that the light has met, else the water if that has scattered
        it, else the surface.
    derivatives
        Names of parameters by which the light is differentiated, from its own paths: ``attenuation``, ``scattering``
        and ``backscattering`` of the water [1/m], each with the other two held fixed, in layered water for each layer
        or, as ``scattering[1]``, for one; ``phase_g`` for ``hg`` functions; ``<id>_reflectance`` for diffuse solids,
        such as ``bottom_reflectance``; ``divergence_mrad`` for Gaussian beams; and ``ripple_variance``, the slope
        variance of the sea's ripples, without the ripples in `ripple_focusing`. Derivatives by other numbers in the
        scene, such as ``bottom_depth`` or ``off_nadir_deg``, are central differences on common random numbers, which
        need two more renders each (`differences.Differences`).
    batches
        Number of pass batches whose waveforms are kept, 2 to 256; none by default. They show how the errors in
        different bins are correlated, as a fit to the result needs to state its own errors.
    smooth
        Standard deviation of a Gaussian that smooths each gate's image in each pass, 0.2 to 20 pixels; none by default.
        Standard errors refer to the smoothed images. Only gates are kept, and passes have fewer paths by default. The
        coordinate ``gate_smoothing_bias`` estimates the change by smoothing.
    light
        'merging' (the default), the integrator, or 'maps': the light of the beam is looked up in maps at several depths
        (`transport.light_maps.renderer`). For images over waves, layers of one index, targets and a bottom. 'level', by
        default 8 passes in about a second, is a first look and a second opinion: such maps below a level sea with all
        of its slopes as ripples, the mean over seas. Light that turns more than once between down and up is left out,
        as are the sides of solids.
    variant
        ``llvm_ad_mono`` or ``cuda_ad_mono``; by default the active one, or the fastest that works here. The previously
        active variant is active again afterwards.
    **others
        Options of `shots.series.render_shots` or `passive.render_passive`, for their results.

    Returns
    -------
    xarray.Dataset
        ``impulse_response`` [J per bin], ``waveform`` [W] (after the pulse and the receiver's response) and their
        standard errors, over (pixel, time) or (row, column, time); see `results.dataset`. With gates in the film,
        ``gate_energy`` [J] in addition or instead; see `results.gate_stack`. With `components`, the parts
        ``impulse_response_by_origin`` and ``waveform_by_origin``, with standard errors, over ``origin`` and the same
        dimensions, whose sums over ``origin`` are the whole. With `derivatives`, ``waveform_derivative`` and
        ``impulse_response_derivative``, with standard errors, over ``parameter`` and the same dimensions. With
        `batches`, ``waveform_batch`` [W], the mean over each batch of passes (as many as the coordinate
        ``batch_passes`` states), over ``batch`` and the same dimensions. After Ctrl-C it includes the completed passes,
        and the attribute ``interrupted`` is 1. A result gives the dataset of the function that rendered it.

    Raises
    ------
    UserError
        If the scene, the result, a parameter or an option is invalid, or no light returns.

    Notes
    -----
    Standard errors come from the passes' spread. Intervals by Student's t have ``passes`` minus 1 degrees of freedom.
    Their coverage is nominal where the error is below a tenth of the value. Where it is 20 to 40 %, 95 % intervals from
    8 passes contain the mean in 91 to 93 % of the bins. Where it is larger, fewer bins do.
    """
    derivatives = [derivatives] if isinstance(derivatives, str) else derivatives
    options = {name: value for name, value in locals().items() if name in engine.RenderOptions.__dataclass_fields__}
    if infrared:
        if again.is_result(scene):
            raise UserError("infrared = True needs a scene: a result of both channels is rendered again with both")
        more: dict[str, Any] = {"sensor": sensor, "integrator": integrator, "progress": progress, **options, **others}
        (_, own), (channel, of_channel) = with_infrared(instrument, params)
        # The cheaper one first, so that its refusals come early.
        beside = uninterrupted(render(scene, of_channel, instrument=channel, **more))
        return join(render(scene, own, instrument=instrument, **more), beside)
    if again.is_result(scene):
        result: Any = scene
        given: dict[str, Any] = {"params": params, "instrument": instrument, "sensor": sensor, "integrator": integrator}
        return render_again(result, **given, progress=progress, **options, **others)
    chosen = engine.RenderOptions(**options, **others)
    session = open_scene(scene, params, instrument, variant=chosen.variant, sensor=sensor)
    return _render(session, integrator, chosen, progress)


def render_again(result: xarray.Dataset | str | Path, **options: Any) -> xarray.Dataset:
    """Render a result again: the same bits on the same machine, unless options change it.

    Raises UserError if the result does not contain its scene, a file of the scene has changed, shots were selected or
    reordered, or an option is invalid.

    `result`: dataset from `render`, `passive.render_passive` or `shots.series.render_shots`, or its file. A dataset
    computed from a result, such as gates or receiver signals, renders that result again. A series gives all shots, or
    the shots that were completed before Ctrl-C. `options`: options of the function that rendered the result, by default
    the values in its attributes. `params` are added to its scene's parameters.

    Result: as from the function that rendered the result.
    """
    import xarray

    functions: dict[str, Callable[..., xarray.Dataset]] = {
        "render": render,
        "passive": render_passive,
        "shots": render_shots,
        "frames": render_frames,
    }
    # Language servers follow options that a function hands to itself without an end.
    kind, chosen = again.recall(result, given := options)
    rendered = functions[kind](**chosen)
    _, infrared = split(result if isinstance(result, xarray.Dataset) else results.open(result))
    return rendered if infrared is None else join(uninterrupted(rendered), render_again(infrared, **given))


def _render(
    session: LoadedScene,
    integrator: str | Mapping[str, Any] | mi.Integrator | None,
    options: engine.RenderOptions,
    progress: ProgressCallback | None,
) -> xarray.Dataset:
    """Render a loaded scene, as `render` describes."""
    seed, components, share = options.seed or 0, bool(options.components), options.pass_share or 1.0
    max_memory = options.max_memory or engine.DEFAULT_MAX_MEMORY_GB
    if components:
        check_solids(sum(not shape.is_medium_transition() for shape in session.scene.shapes()))
    sensor, chosen = session.sensor, choose_integrator(session.scene, integrator)
    by_maps, is_level = options.light in ("maps", "level"), options.light == "level"
    if by_maps:
        found = find_lidar_scene(session.scene, sensor)
        is_image = not is_level or found.receiver.is_imager
        renderer: PassRenderer = LightMapRenderer(found, PathClasses(), level=is_level, image=is_image)
    else:
        renderer = chosen.prepare(session.scene, sensor)
    if components:
        renderer = renderer.by_origin()
    lidar: LidarScene = renderer.scene
    parameters = path_parameters(renderer, options.derivatives or [], others=session.parameters)
    moved = [one.name for one in parameters if one.perturbation is None]
    differences = Differences(session, chosen, moved, renderer=renderer) if moved else None
    session.tell_axis(lidar.axis, lidar.record_end)
    if changes := perturbations(parameters):
        renderer = renderer.perturbed(changes)
    window = ErrorWindow.of_probe(renderer.probe)
    check_scene(renderer.probe)
    described = describe_scene(renderer.probe, window, renderer.focusing)
    origins = renderer.classes.names if components else []
    surface = described.get("surface_time_ns")
    accumulator = choose_accumulator(
        lidar,
        window,
        surface,
        max_memory,
        origins,
        parameters,
        differences,
        options.batches or 0,
        options.smooth,
        renderer.memory,
    )
    default = DEFAULT_GOAL if accumulator.train is None else DEFAULT_GATE_GOAL
    default = engine.Goal(passes=engine.SMALLEST_PASS_COUNT) if is_level else default
    goal = engine.Goal.from_options(
        options.target_error, options.max_time, options.passes, default, options.target_quantile
    )
    full = renderer.for_smoothing(share_of_pass(options.smooth)) if options.smooth else renderer
    fitted = full if share == 1 else full.scaled(share)
    if lidar.receiver.is_imager:
        cost = describe_cost(fitted, accumulator.size, float(window.start_ns.min()), len(accumulator.tiles))
        logger.info("%s", cost)

    def render_pass(number: int, seed: int) -> float:
        nonlocal fitted, share
        gates, beside, first = accumulator.gate_weights, accumulator.gates_beside, None
        if number == 0 and goal.max_time is not None and options.pass_share is None:
            start_ns = float(window.start_ns.min())
            tiles = accumulator.tiles
            fitted, share, first = fit_to_time(full, goal.max_time, start_ns, seed=seed, gates=gates, tiles=tiles)
        received = None if beside else first
        lost = 0.0
        for tile in accumulator.tiles:
            received = received or fitted.render_pass(seed, gates=gates, beside=beside, tile=tile)
            accumulator.add(received.histogram, received.gated, tile)
            # The loss is of all pixels.
            lost, received = received.edge_loss, None
        if differences is not None:
            differences.add_pass(seed, share)
        return lost

    log = engine.run_passes(
        render_pass,
        goal,
        seed=seed,
        errors=accumulator.errors,
        errors_of="bins" if accumulator.train is None else "gates",
        verify=accumulator.require_light,
        progress=progress,
    )
    if lidar.receiver.is_imager:
        dr.flush_malloc_cache()  # Dr.Jit keeps the memory of passes
    missed = renderer.probe.echoes.missed_beam
    if lidar.surfaces and missed > engine.TOLERATED_LOSS:
        logger.warning(
            "the surface is smaller than the footprint: %.2g %% of the beam in the field of view passes outside it; "
            "enlarge the surface's size",
            100 * missed,
        )
    lost = log.edge_loss_share(accumulator.received)
    engine.warn_of_edge_loss(lost)
    attributes = session.attributes(
        lidar,
        chosen,
        renderer.used_values,
        **log.attributes(seed),
        pass_share=share,
        max_memory_gb=max_memory,
        components=int(components),
        **({"derivatives": [one.name for one in parameters]} if parameters else {}),
        **({"batches": options.batches} if options.batches else {}),
        **({"smooth_pixels": options.smooth} if options.smooth else {}),
        **({"light": options.light} if by_maps else {}),
        elapsed_s=log.elapsed_s,
        error_median=log.error_median,
        error_p95=log.error_p95,
        surface_edge_loss=lost,
        **described,
    )
    return with_lines_of_sight(accumulator.dataset(attributes), lidar)
