"""A narrow beam in a wide view
============================

Survey lidars have beams of a milliradian in views ten times wider. The light spreads in the water by scattering: the
bottom echo comes from a spot that is wider than the beam, and later than along the axis.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# The same 40 mrad receiver with a 0.5 mrad beam and a 10 mrad beam. The bottom is at 16 m, and the lidar looks 20
# degrees off nadir.

options = {"passes": 8, "pass_share": 1 / 4, "seed": 1}
scene = {"layout": "1x1", "field_of_view_mrad": 40, "bottom_depth": 16, "spectrum": "flat"}
scene |= {"pulse_fwhm_ns": 2, "bin_width_ns": 0.5}
shots = {
    divergence: mitransient_lidar.render("table1", params={**scene, "divergence_mrad": divergence}, **options)
    for divergence in (0.5, 10)
}

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.4), layout="constrained")
for divergence, shot in shots.items():
    one = shot.isel(pixel=0)
    depth = (one.time - one.surface_time) * one.depth_per_ns
    left.semilogy(depth, 1e6 * one.waveform, label=f"{divergence} mrad")
    near = (depth > 14) & (depth < 18.5)
    right.plot(depth[near], 1e6 * one.waveform[near])
    peak = float(depth[near][np.argmax(one.waveform[near].values)])
    print(
        f"{divergence} mrad: highest bin of the bottom echo at {peak:.2f} m, "
        f"standard error of a bin (median) {100 * shot.error_median:.1f} %"
    )
left.set(xlabel="depth (m)", ylabel="power (µW)", ylim=(1e-3, 1000), xlim=(-1, 20))
left.legend(frameon=False)
right.axvline(16, color="0.6", linestyle="--")
right.set(xlabel="depth (m)", ylabel="power (µW)")
plt.show()

# %%
# **What to see.** The narrow beam has a surface echo, and a bottom echo that is half as high again and narrower. The
# wide beam's footprint, seen at 20 degrees, stretches both. Deep in the water the columns agree, as the view contains
# both beams. The narrow beam's bottom echo is wider than its 2 ns pulse, 0.2 m on this axis, since the water has spread
# it.
