"""Number of paths in a pass, reduced where full passes would exceed a time limit."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.constants import C0
from mitransient_lidar.rendering.passes import SMALLEST_SHARE
from mitransient_lidar.transport.paths.histogram import GateWeights
from mitransient_lidar.transport.paths.passes import PassRenderer, ReceivedLight
from mitransient_lidar.transport.scene import LidarScene

logger = logging.getLogger(__name__)

#: Number of smaller passes that should fit into the time, and of full passes that must.
_SMALL_PASSES, _FULL_PASSES = 4, 2

#: Rays that a slow machine traces per second (1 to 2 million on two cores): passes with fewer rays than it traces in
#: twice the time need no trial.
_RAYS_PER_SECOND = 1e6

#: Paths of a kernel that one thread follows at a time, and those that a GPU follows at once.
_PATHS_PER_THREAD, _PATHS_ON_GPU = 2**14, 2**17


def fit_to_time(
    renderer: PassRenderer,
    max_time: float,
    start_ns: float,
    *,
    seed: int,
    gates: GateWeights | None,
    tiles: Sequence[range | None] = (None,),
) -> tuple[PassRenderer, float, ReceivedLight | None]:
    """Return a renderer whose passes fit into a time limit, with fewer paths where full passes do not.

    Kernels cannot be interrupted. Where many rays are expected for the time, a trial with 1/512 of the paths measures
    the kernel time. If two full passes would exceed the limit, the path number is halved. It is halved until four
    passes fit, or the work besides the kernels takes longer.

    `renderer`: renderer for full passes. `max_time`: time limit for the render [s]. `start_ns`: time at which light
    enters the water [ns]. `seed`, `gates`: arguments of `PassRenderer.render_pass` for the first pass. `tiles`: tiles
    of pixels in each pass, or None for all.

    Returns `renderer`: renderer for the passes. `share`: its share of a full pass's paths. `first`: record of the first
    pass, if it is rendered already, without tiles.
    """
    paths = renderer.path_count
    if paths * _rays_per_path(renderer.scene, start_ns) < 2 * max_time * _RAYS_PER_SECOND:
        return renderer, 1.0, None
    began = time.perf_counter()
    trial = renderer.scaled(SMALLEST_SHARE)
    received, kernels, rest = timed_pass(trial, seed, gates, tiles)
    if _SMALL_PASSES * kernels < max_time:
        # Without buffer growth and kernel compilation, which belong to the first trial.
        received, kernels, rest = timed_pass(trial, seed, gates, tiles)
    left = max_time - (time.perf_counter() - began)

    def kernels_of(share: float) -> float:
        return kernels * (share / SMALLEST_SHARE) * _at_once(SMALLEST_SHARE * paths) / _at_once(share * paths)

    if _FULL_PASSES * (rest + kernels_of(1.0)) <= left:
        return renderer, 1.0, None
    share = 0.5
    while share > SMALLEST_SHARE and kernels_of(share) > max(left / _SMALL_PASSES - rest, rest):
        share *= 0.5
    logger.info("passes have 1/%d of the paths, so that they fit into max_time = %g s", round(1 / share), max_time)
    return (renderer.scaled(share), share, None) if share > SMALLEST_SHARE else (trial, share, received)


def describe_cost(renderer: PassRenderer, size: float, start_ns: float, tiles: int = 1) -> str:
    """Return a line with the memory of a render [bytes], and a pass's longest time on two slow cores."""
    pixels, rays = renderer.scene.receiver.pixels.count, renderer.path_count * _rays_per_path(renderer.scene, start_ns)
    return (
        f"{pixels} pixels{f' in {tiles} tiles' if tiles > 1 else ''}: the render takes {1e-9 * size:.3g} GB with the "
        f"program, and a pass of {renderer.path_count} paths at most about {rays / _RAYS_PER_SECOND:.2g} s on two cores"
    )


def _rays_per_path(scene: LidarScene, start_ns: float) -> float:
    """Return a path's largest expected number of rays: scattering events until the record's end, and ends."""
    if scene.water is None:
        return 2.0
    plume = scene.water.plume
    scattering = float(scene.water.column.scattering.max()) + (plume.scattering if plume is not None else 0.0)
    length = C0 * 1e-9 * max(scene.axis.end_ns - start_ns, 0.0) / scene.group_index
    return 2.0 + scattering * length


def timed_pass(
    renderer: PassRenderer, seed: int, gates: GateWeights | None, tiles: Sequence[range | None]
) -> tuple[ReceivedLight | None, float, float]:
    """Render a pass; return it, the time of its kernels, and the other time except for their compilation [s].

    A pass in `tiles` is not kept.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        began = time.perf_counter()
        for tile in tiles:
            received: ReceivedLight | None = None  # without two tiles at once
            received = renderer.render_pass(seed, gates=gates, tile=tile)
        dr.sync_thread()
        total = time.perf_counter() - began
        history = dr.kernel_history()
    kernels = 1e-3 * sum(kernel["execution_time"] for kernel in history)
    compilation = 1e-3 * sum(kernel.get("codegen_time", 0.0) + kernel.get("backend_time", 0.0) for kernel in history)
    return received if len(tiles) == 1 else None, kernels, max(total - kernels - compilation, 0.0)


def _at_once(paths: float) -> float:
    """Return how many threads, or on a GPU paths, share a kernel with a number of paths."""
    if "cuda" in mi.variant():
        return min(max(paths, 1.0), _PATHS_ON_GPU)
    return min(max(paths / _PATHS_PER_THREAD, 1.0), float(dr.thread_count()))
