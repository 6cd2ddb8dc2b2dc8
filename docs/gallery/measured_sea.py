"""A measured sea
==============

A height map, from stereo cameras, a topographic lidar or a wave model, is the sea surface of a scene: an array with
positions in ``.npz``, NetCDF, GeoTIFF, ESRI ASCII, or scattered points. What the map does not resolve remains as
ripples.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# This example's map is computed: a 12 m long swell towards +x, with short crossing waves, in 10 cm cells.

x = y = np.arange(-15, 15.05, 0.1)
heights = 0.25 * np.sin(2 * np.pi * x / 12)[None, :] + 0.02 * np.cos(2 * np.pi * (x[None, :] + y[:, None]) / 2.1)


def scene(file, aim_x):
    """Return a lidar that aims at (aim_x, 0) on the sea of a height map."""
    place = {"altitude": 200.0, "off_nadir_deg": 10.0, "aim_x": aim_x}
    sea = {"spectrum": "height_map", "filename": str(file), "slope_variance": 0.02, "size": 1000.0}
    return {
        "type": "scene",
        "integrator": {"type": "lidar_merging"},
        "laser": {"type": "lidar_transmitter", "divergence_mrad": 5.0, "pulse_fwhm_ns": 2.0, **place},
        "receiver": {
            "type": "multipixel_receiver",
            **{"layout": "1x1", "field_of_view_mrad": 15.0, **place},
            "film": {"type": "time_gated_film", "bin_width_ns": 0.5},
        },
        "surface": {"type": "ocean_surface", **sea, "interior": {"type": "layered_water"}},
        "bottom": {"type": "seabed", "depth": 5.0, "reflectance": 0.1},
    }


# %%
# Two shots: on the face towards the lidar, which looks towards +x, and on the face behind the crest.

with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "sea.npz"
    np.savez(file, heights=heights, x=x, y=y)
    shots = {
        name: mitransient_lidar.render(scene(file, aim_x), passes=8, pass_share=1 / 16, seed=1)
        for name, aim_x in (("facing the lidar", 0.0), ("facing away", 6.0))
    }

for name, shot in shots.items():
    start = float(shot.surface_time[0])
    surface = float(shot.impulse_response.sel(time=slice(None, start + 3)).sum())
    bottom = float(shot.waveform.isel(pixel=0).sel(time=slice(start + 30, None)).idxmax("time"))
    print(f"{name}: {1e12 * surface:.1f} pJ up to 3 ns after the mean surface, peak of the bottom at {bottom:.2f} ns")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.2), layout="constrained")
image = left.pcolormesh(x, y, heights, cmap="Blues_r", rasterized=True)
for (name, shot), aim_x in zip(shots.items(), (0.0, 6.0), strict=True):
    left.plot(aim_x, 0, "o", markersize=8, markeredgecolor="white")
    right.semilogy(shot.time, 1e6 * shot.waveform.isel(pixel=0), label=name)
left.set(xlabel="x, away from the lidar (m)", ylabel="y (m)", aspect="equal")
figure.colorbar(image, ax=left, label="height (m)", shrink=0.8)
right.set(xlabel="time (ns)", ylabel="power (µW)", xlim=(1345, 1415), ylim=(1, None))
right.legend(frameon=False, fontsize="small")
plt.show()

# %%
# **What to see.** From the face that is turned towards it (blue) the lidar receives a surface echo a thousand times
# brighter than the water. The face that is turned away (orange) has no visible surface echo. Column and
# bottom are nearly the same, and the bottom echo comes half a nanosecond earlier through the face that is turned
# away.
