"""Copies of shipped scenes whose integrator takes few paths, for commands and studies that take no other one."""

from mitransient_lidar.loading import catalogue

_FEW = '<integrator type="lidar_volpath"><integer name="paths_per_pass" value="8192"/></integrator>'


def few_paths(name, folder):
    """Write a shipped scene with 8192 paths a pass to ``small.xml`` in a folder, and return its path."""
    text = catalogue.scene_text(name).replace('<integrator type="lidar_merging"/>', _FEW)
    assert _FEW in text
    path = folder / "small.xml"
    path.write_text(text, "utf-8")
    return path
