"""Mast lidars of several heights and angles
=========================================

Figure 3 of the publication sketches a mast lidar at several heights and angles of incidence on the sea. Here each of
these geometries is rendered over the target of its figure 4, a square metre 1 m below the surface.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

HEIGHTS, GRAZING_DEG = (5.0, 15.0, 30.0), (5.4, 15.0, 30.0)
INDEX, DEPTH = 1.34, 1.0

# %%
# The plate is turned to face the refracted light, and stands where the axis meets it below a level sea. Its echo is
# compared with the water's light within 5 ns of it. The sea has its slopes, but no waves that hide parts of it: with
# waves a render is valid for one sea only (``spectrum`` = ``elfouhaily``).


def render(height, grazing_deg):
    """Return the distance through the air (m), and energies (J) of the target and of the water about it."""
    grazing = np.radians(grazing_deg)
    in_water = np.arcsin(np.cos(grazing) / INDEX)  # from the vertical
    place = {"target_x": float(DEPTH * np.tan(in_water)), "target_tilt_deg": float(np.degrees(in_water))}
    pose = {"altitude": height, "off_nadir_deg": 90 - grazing_deg}
    shot = mitransient_lidar.render(
        "fig04_mast",
        params={**place, **pose, "layout": "1x1", "spectrum": "flat"},
        **{"passes": 8, "pass_share": 1 / 16, "seed": 1, "components": True},
    )
    distance = height / np.sin(grazing)
    due = 2e9 / 299792458 * (distance + INDEX * DEPTH / np.cos(in_water))
    light = shot.impulse_response_by_origin.sum("pixel").sel(time=slice(due - 5, due + 5)).sum("time")
    return distance, float(light.sel(origin="target")), float(light.sel(origin="water"))


found = {grazing: np.array([render(height, grazing) for height in HEIGHTS]) for grazing in GRAZING_DEG}
for grazing, rows in found.items():
    for height, (distance, target, water) in zip(HEIGHTS, rows, strict=True):
        print(f"{height:4.0f} m, {grazing:4.1f} deg: {distance:4.0f} m, {target:.2e} J, {target / water:4.1f} x water")

# %%
# The geometry, and the target's echo energy over the distance through the air.

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", width_ratios=(1.5, 1))
for number, (grazing, rows) in enumerate(found.items()):
    for height in HEIGHTS:
        reach = height / np.tan(np.radians(grazing))
        left.plot([0, reach], [height, 0], color=f"C{number}", label=f"{grazing:g}°" if height == HEIGHTS[0] else None)
    right.loglog(rows[:, 0], rows[:, 1], "o-", color=f"C{number}", label=f"{grazing:g}°")
left.plot([0, 0], [0, max(HEIGHTS)], color="0.3", linestyle="-", linewidth=3)
left.axhline(0, color="0.6")
left.set(xlabel="distance from the mast (m)", ylabel="height (m)")
left.legend(frameon=False, title="grazing angle")
right.set(xlabel="distance through the air (m)", ylabel="energy of the target's echo (J)")
plt.show()

# %%
# **What to see.** The distance through the air, left, grows as the angle falls: 319 m from 30 m at 5.4 degrees. There
# the echo is 67 000 times weaker than from 5 m at 30 degrees. Less light enters the water, and beam and view are wider
# than the plate. It still has 11 times as much light as the water about it, and 26 to 150 times elsewhere.
