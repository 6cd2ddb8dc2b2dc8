"""Every shipped scene: silent checks, light where it should be, files, and the same bits again."""

import json
import logging

import numpy as np
import pytest
from rows import each_case
from same_bits import assert_same_bits

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.loading import catalogue, scenes
from mitransient_lidar.results import sum_errors

FEW = {"type": "lidar_volpath", "paths_per_pass": 4096}

#: Images are of few pixels here.
IMAGE = {"layout": "8x8", "surface_cell_size": "0.2"}
#: Its sand has ripples in 160 m.
SMALL = {"flight": {"bottom_refined_size": "20"}}

#: As another scene, but for layout, place or water.
ALIKE = {
    *("fig09_1x1", "fig09_2x2", "fig10_shot1", "fig10_shot2", "fig10_shot3", "fig11_shot2", "fig11_shot3"),
    *("fig13_2x2", "fig14_1x4", "fig15_1x1", "gated_waves", "nepheloid_layer"),
    *("table1", "thin_layer"),
}

#: Rendered by an integrator of its own; see `test_again`.
PASSIVE = {"passive_sea"}


@each_case(
    *zip(
        [
            pytest.param(name, marks=pytest.mark.long if name in ALIKE else pytest.mark.slow)
            for name in sorted(set(catalogue.scene_names()) - PASSIVE)
        ]
    )
)
def test_scene(name, tmp_path, caplog):
    """One small render, its files, and renders of these.

    A scene whose integrator draws from anything but the seed, or a parameter that a file does not keep, gives other
    bits; a target outside the view or a record that is too short, a warning.
    """
    image = catalogue.scene_parameters(name)["layout"] == "128x128"
    params = {"pulse_energy_mj": "4", **(IMAGE if image else {}), **SMALL.get(name, {})}
    with caplog.at_level(logging.WARNING):
        first = mitransient_lidar.render(name, params=params, integrator=FEW, passes=2, seed=3)
    assert caplog.messages == []
    assert first.attrs["scene.pulse_energy_mj"] == "4"
    count = first.attrs["scene.bin_count"]
    assert count == "auto" or first.sizes["time"] == int(count)
    energy = first["impulse_response"]
    assert energy.dims == (("row", "column", "time") if image else ("pixel", "time"))
    assert np.isfinite(first["waveform"]).all()
    assert (energy.min("time") >= 0).all()
    assert float(energy.sum()) > 0
    if name in ALIKE:
        return
    # EXR keeps 32 bits, NetCDF everything.
    for suffix, rtol in ((".exr", 6e-8), (".nc", 0)):
        kept = first.drop_dims(["gate", *sum_errors.DIMS], errors="ignore") if suffix == ".exr" else first
        results.save(kept, tmp_path / f"a{suffix}")
        again = mitransient_lidar.open(tmp_path / f"a{suffix}")
        for variable in kept.data_vars:
            np.testing.assert_allclose(again[variable], first[variable], rtol=rtol, atol=1e-38)
        assert again.attrs == first.attrs
        for coordinate in kept.coords:
            assert again[coordinate].values.tolist() == kept[coordinate].values.tolist()
    assert_same_bits(first, mitransient_lidar.render(tmp_path / "a.nc"))
    # Its lidar may be another one.
    opened = scenes.open_scene(name, instrument="riegl_vq840g")
    mounted, parameters = opened.scene, opened.parameters
    assert mounted.sensors()[0].receiver.pixels.names == list(catalogue.read_instrument("riegl_vq840g").channels)
    assert parameters["altitude"] == "150"


@pytest.mark.slow
def test_automatic_numbers_of_merging():
    """As many paths as photons, cells of centimetres and points of decimetres, which the result states and repeats."""
    first = mitransient_lidar.render("table1", passes=2)
    used = json.loads(first.attrs["plugin_parameters"])["integrator"]["used"]
    assert (used["paths_per_pass"], used["photons_per_pass"]) == (32768, 32768)
    assert 0.001 < used["cell_size"] < 0.05 < used["point_spacing"] < 5
    assert_same_bits(first, mitransient_lidar.render(first))
