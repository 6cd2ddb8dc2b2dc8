"""Detection of a target with several pixels
=========================================

Pixels that look past a target receive only backscatter. Weighting pixels by echo over backscatter detects better than
adding them, which one large pixel does.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar
from mitransient_lidar.plots.palette import pixel_colours

# %%
# A square 1.5 m target at 8 m, in the published scenes with 2x2 pixels and with four strips. With ``components`` the
# target's light is separate from water and bottom light.

options = {"components": True, "passes": 8, "pass_share": 1 / 4, "seed": 1}
shots = {
    layout: mitransient_lidar.render(scene, params={"spectrum": "flat"}, **options)
    for layout, scene in (("2x2", "fig13_2x2"), ("1x4", "fig14_1x4"))
}

# %%
# Where the backscatter's shot noise limits, a pixel's noise variance is proportional to its backscatter B in the gate
# with the echo E. The signal-to-noise ratio of a sum with weights w is then sum(w E) / sqrt(sum(w^2 B)), which is
# largest for w = E/B.

figure, axes = plt.subplots(1, 2, figsize=(7, 3.3), sharey=True, layout="constrained")
for axis, (layout, shot) in zip(axes, shots.items(), strict=True):
    target = shot.waveform_by_origin.sel(origin="target")
    others = shot.waveform - target
    peak = float(target.sum("pixel").idxmax("time"))
    gate = slice(peak - 5, peak + 5)
    echo, background = (light.sel(time=gate).sum("time").values for light in (target, others))
    best = np.sqrt(np.sum(echo**2 / background))
    gain = best / (echo.sum() / np.sqrt(background.sum()))
    print(f"{layout}: shares of the echo {np.round(echo / echo.sum(), 2)}, contrasts {np.round(echo / background, 1)}")
    print(f"    signal-to-noise ratio with the best weights over that of the sum: {gain:.2f}")
    for pixel, colour in zip(shot.pixel.values, pixel_colours(4), strict=True):
        axis.semilogy(shot.time, 1e6 * target.sel(pixel=pixel), color=colour, label=str(pixel))
        axis.semilogy(shot.time, 1e6 * others.sel(pixel=pixel), color=colour, linestyle=":", linewidth=1)
    axis.set(title=layout, xlabel="time (ns)", xlim=(1465, 1515), ylim=(0.1, None))
    axis.axvspan(gate.start, gate.stop, color="0.93", zorder=0)
axes[0].set_ylabel("power (µW)")
axes[1].legend(frameon=False, fontsize="small")
plt.show()

# %%
# **What to see.** Solid lines are the target, dotted ones all other light; the echo's gate is grey. Among 2x2 pixels,
# the near ones (blue, black, one above the other) have nearly all of the echo. The nearest strip (black) has less of
# the echo than blue, but the best contrast, as little water is in its view at that time. Far pixels add backscatter and
# no echo to a sum.
