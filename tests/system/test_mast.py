"""A lidar on a mast: 5.4 degrees grazing, waves that hide each other, and a square metre 1 m below the surface."""

import mitsuba as mi
import numpy as np
import pytest

from mitransient_lidar.loading import scenes


@pytest.mark.slow
def test_waves_hide_what_geometry_says():
    """Rays from the sea to the mast against the horizon of height profiles in plain NumPy, towards -x."""
    scene = scenes.open_scene("fig04_mast", {"wind_speed": 6}).scene
    sea = next(shape.sea for shape in scene.shapes() if hasattr(shape, "sea"))
    mast = scene.sensors()[0].receiver.pose.origin
    rows = np.arange(-20, 20) * 4 * sea.cell_size
    columns = np.arange(-int(18 / sea.cell_size), int(10 / sea.cell_size)) * sea.cell_size
    heights = sea.heights(columns, rows)
    # Slope of the ray to the mast against the steepest slope to what stands in between.
    places = range(len(columns) // 2, len(columns))
    hidden = np.zeros((len(rows), len(places)), dtype=bool)
    for index, place in enumerate(places):
        away = columns[place] - columns[:place]
        steepest = np.max((heights[:, :place] - heights[:, [place]]) / away, axis=1)
        hidden[:, index] = steepest > (mast[2] - heights[:, place]) / (columns[place] - mast[0])
    x, y = np.meshgrid(columns[len(columns) // 2 :], rows)
    z = heights[:, len(columns) // 2 :]
    point = np.stack([x, y, z + 1e-3], axis=-1).reshape(-1, 3)
    towards = mast - point
    towards[:, 1] = 0  # in the plane of the profile
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(point.T.copy()), mi.Vector3f(towards.T.copy()))
    ray.maxt = 14.0
    blocked = np.array(scene.ray_test(ray)).reshape(hidden.shape)
    assert 0.02 < hidden.mean() < 0.9
    # Facets hang a little below and above the profile's points between them.
    assert abs(blocked.mean() - hidden.mean()) < 0.03
    assert (blocked == hidden).mean() > 0.95
