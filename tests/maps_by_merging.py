"""Compare light maps with merging over 60 places a kind of scene: the table of light maps in ``docs/performance.md``.

``nice python tests/maps_by_merging.py [NAME ...]`` renders each kind by two passes of maps and by merging to 2 %. It
prints differences of echo depths [cm], bottom energies and slabs of 1 m of water [%], and z of depths with the errors
of both renders. Each kind takes minutes.
"""

import sys
import time

import numpy as np
import xarray as xr

import mitransient_lidar as mt
from mitransient_lidar.results.sum_errors import pooled_errors

#: Kinds: scene, parameters, instrument.
KINDS = {
    "wind 3, 8 m, c 0.3": ("table1", {"wind_speed": 3, "bottom_depth": 8, "attenuation": 0.3, "scattering": 0.2}, None),
    "wind 5, 10 m, c 0.15": (
        "table1",
        {"wind_speed": 5, "bottom_depth": 10, "attenuation": 0.15, "scattering": 0.1},
        None,
    ),
    "wind 5, 5 m, c 0.8": ("table1", {"wind_speed": 5, "bottom_depth": 5, "attenuation": 0.8, "scattering": 0.6}, None),
    "wind 10, 6 m, c 0.3": (
        "table1",
        {"wind_speed": 10, "bottom_depth": 6, "attenuation": 0.3, "scattering": 0.2},
        None,
    ),
    "wind 5, 5 m, c 1.5": ("table1", {"wind_speed": 5, "bottom_depth": 5, "attenuation": 1.5, "scattering": 1.2}, None),
    "VQ-840-G, 1C, 6 m": (
        "table1",
        {"wind_speed": 5, "bottom_depth": 6, "jerlov": "1C", "altitude": 120},
        "riegl_vq840g",
    ),
    "EAARL-B, 1C, 6 m": (
        "table1",
        {"wind_speed": 5, "bottom_depth": 6, "jerlov": "1C", "altitude": 300},
        "usgs_eaarl_b",
    ),
    "CZMIL, 1C, 8 m": (
        "table1",
        {"wind_speed": 5, "bottom_depth": 8, "jerlov": "1C", "altitude": 400},
        "teledyne_czmil",
    ),
    "azimuth 60, 8 m, c 0.3": (
        "table1",
        {"wind_speed": 5, "bottom_depth": 8, "attenuation": 0.3, "scattering": 0.2, "wind_direction_deg": 60},
        None,
    ),
    "layers (fig15_2x2)": ("fig15_2x2", {}, None),
}
PLACES, ERROR, DEPTH_PER_NS = 60, 0.02, 0.5 * 0.299792458 / 1.34


def measured(both: list[xr.Dataset]) -> list[xr.Dataset]:
    """Return the echoes of two series, each with the errors of both as flights have them: other weights are a bias."""
    few = [one.assign(waveform_stderr=pooled_errors(one, few=True)) for one in both]
    pooled = [pooled_errors(one, few=False) for one in few]
    error = np.hypot(*(one.values for one in pooled))
    return [mt.echoes(one.assign(waveform_stderr=(pooled[0].dims, error)), targets=1) for one in both]


def slabs(series: xr.Dataset) -> np.ndarray:
    """Return energies in slabs of 1 m from 1 m below the surface to 1 m above the bottom, (slabs, shots, pixels)."""
    found = []
    depth = series["true_bottom_depth"].values[:, np.newaxis]
    start = series["surface_time"].values if "surface_time" in series else series.attrs["surface_time_ns"]
    below = (series["time"].values - np.reshape(start, (1, -1, 1))) * DEPTH_PER_NS
    for top in np.arange(1.0, float(np.nanmin(depth)) - 2.0):
        inside = (below >= top) & (below < top + 1)
        found.append(np.where(inside, series["impulse_response"].values, 0).sum(axis=-1))
    return np.array(found)


def compared(name: str) -> str:
    """Return one kind's row."""
    scene, params, instrument = KINDS[name]
    began = time.process_time()
    options = {"instrument": instrument, "count": PLACES, "seed": 63}
    maps = mt.render_shots(scene, params, light="maps", **options)
    by_maps = time.process_time() - began
    merged = mt.render_shots(scene, params, target_error=ERROR, first_seed=1000, axis=None, **options)
    both = measured([maps, merged])
    depth, error, energy, kind = (
        [one[variable].sel(echo="bottom").values for one in both]
        for variable in ("depth_m", "depth_m_stderr", "energy", "class")
    )
    found = [np.isfinite(each) & (number > 0) for each, number in zip(depth, kind, strict=True)]
    used = found[0] & found[1]
    apart = 100 * (depth[0] - depth[1])[used]
    z = apart / 100 / error[0][used]
    bottom, water = 100 * (energy[0] / energy[1] - 1)[used], [slabs(one) for one in (maps, merged)]
    lit = water[1] > 0.05 * water[1].max(axis=(1, 2), keepdims=True)
    slab = 100 * (water[0][lit] / water[1][lit] - 1)
    return (
        f"| {name} | {apart.mean():+.2f} +- {apart.std():.2f} | {np.mean(np.abs(apart) < 1):.0%} | "
        f"{bottom.mean():+.1f} +- {bottom.std():.1f} | {slab.mean():+.1f} +- {slab.std():.1f} | "
        f"{np.sqrt(np.mean(z**2)):.2f} | {found[0].sum()}, {found[1].sum()} of {used.size} | {by_maps:.0f}, "
        f"{time.process_time() - began - by_maps:.0f} s |"
    )


if __name__ == "__main__":
    for one in sys.argv[1:] or KINDS:
        print(compared(one), flush=True)
