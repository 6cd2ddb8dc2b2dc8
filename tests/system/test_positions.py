"""Points of a rendered shot: a bottom that rises to the left and falls away from the lidar has its true heights."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import mitransient_lidar
from mitransient_lidar import scenes
from mitransient_lidar.analysis.waveforms.echo_table import extract
from mitransient_lidar.flights.positions import PointClass, positions
from mitransient_lidar.flights.refracted_paths import PoseErrors
from mitransient_lidar.physics.lidar.pose import Pose

SEABED = """<shape type="seabed"><float name="depth" value="8"/><float name="size" value="80"/>
<float name="slope_x_deg" value="-4"/><float name="slope_y_deg" value="8"/></shape>"""


@pytest.mark.slow
def test_points_of_a_tilted_bottom_have_its_heights(tmp_path):
    """With left and right, or far and near, exchanged, heights would be off by 0.2 m."""
    for path in Path(scenes.__path__[0]).glob("_*.xml"):
        shutil.copy(path, tmp_path)
    text = (Path(scenes.__path__[0]) / "table1.xml").read_text()
    (tmp_path / "tilted.xml").write_text(text.replace('<include filename="_flat_bottom.xml"/>', SEABED))
    params = {"layout": "2x2", "time_start_ns": 1400, "bin_count": 200, "spectrum": "flat"}
    few = {"type": "lidar_merging", "paths_per_pass": 2**14, "photons_per_pass": 2**14}
    shot = mitransient_lidar.render(tmp_path / "tilted.xml", params=params, integrator=few, passes=8)
    pose = Pose(*np.reshape(shot.attrs["receiver_pose"], (4, 1, 3)))
    sight = (1e-3 * shot[name].values for name in ("sight_x", "sight_y"))
    points = positions(
        *(extract(shot).expand_dims("shot"), pose, *sight),
        refractive_index=shot.attrs["refractive_index"],
        group_index=shot.attrs["group_index"],
        errors=PoseErrors(0, 0, 0, 0, 0, 0),
    )
    bottom = points.isel(point=points["kind"].values == PointClass.BOTTOM)
    assert bottom["pixel"].values.tolist() == [0, 1, 2, 3]
    true = -8 - np.tan(np.radians(4)) * bottom["x"] + np.tan(np.radians(8)) * bottom["y"]
    error = bottom["z"] - true
    assert np.all(np.abs(error) < 3 * bottom["vertical_uncertainty"]), error.values
    assert float(np.abs(error).max()) < 0.1
    assert np.ptp(true.values) > 0.3
