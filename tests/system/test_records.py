"""Records that fit by themselves: all light is within, attributes, gates, and numbers that win."""

import json

import mitsuba as mi
import numpy as np
import pytest
from command_line import assert_refused, run
from rows import each_case, must_refuse
from significance import largest_z, mean_and_error

import mitransient_lidar
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.lidar.pulse import waveform
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.scene_parts import find_lidar_scene

FEW = {"type": "lidar_volpath", "paths_per_pass": 4096}
SMALL = {"surface_size": 60, "bin_width_ns": 4}
TURBID = {"attenuation": 2.19, "scattering": 1.824, "backscattering": 0.03643}

GEOMETRIES = [
    {"off_nadir_deg": 0, "altitude": 50, "wind_speed": 10},
    {"bottom_depth": 30},
    {"altitude": 15, "off_nadir_deg": 85},
    {"bottom_depth": 3, "field_of_view_mrad": 100, **TURBID},
]


def prepared(scene, params=None):
    session = open_scene(scene, params)
    return find_lidar_scene(session.scene, session.sensor)


def beside(offset, film=None):
    """A scene whose receiver is beside the laser of table 1 [m] and looks at the same place."""
    transform = mi.ScalarTransform4f()
    origin = np.array([-200 * np.tan(np.radians(20)), 0, 200]) + offset
    return {
        "integrator": {"type": "lidar_merging", "paths_per_pass": 2**14, "photons_per_pass": 2**14},
        "tx": {"type": "lidar_transmitter"},
        "rx": {
            "type": "multipixel_receiver",
            "to_world": transform.look_at(origin=origin.tolist(), target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "time_gated_film", "bin_width_ns": 1.0, **(film or {})},
        },
        "sea": {"type": "ocean_surface", "wind_speed": 5.0, "interior": {"type": "layered_water"}},
        "bottom": {"type": "seabed", "depth": 8.0},
    }


@pytest.mark.slow
@pytest.mark.parametrize("params", GEOMETRIES)
def test_echoes_of_rays_through_the_waves_are_within(params):
    lidar = prepared("table1", params)
    probe = Probe(lidar).echoes
    first, last = np.nanmin(probe.surface_ns), np.nanmax(probe.bottom_ns)
    lead = 3 * lidar.transmitter.pulse.fwhm_ns
    assert lidar.axis.start_ns < first - lead
    assert lidar.axis.end_ns > last + lead
    # No more than twice as long as its echoes, and 200 ns.
    assert lidar.axis.end_ns - lidar.axis.start_ns < 2 * (last - first) + 200


@each_case(
    pytest.param((-50, 0, -100), marks=pytest.mark.slow),
    pytest.param((0, 50, 0), marks=pytest.mark.long),
    pytest.param((50, 0, 0), marks=pytest.mark.long),
)
def test_less_than_1e_4_of_the_energy_is_outside_of_a_receiver_beside_the_laser(offset):
    outside(lambda film: (beside(offset, film), None))


def outside(scene):
    """Check that a far longer record holds no more energy; `scene` takes parameters of a film."""
    axis = prepared(*scene({})).axis
    before, after = (int(length / axis.bin_width_ns) for length in (300, 600))
    film = {"time_start_ns": axis.start_ns - before * axis.bin_width_ns, "bin_count": before + axis.bin_count + after}
    session = open_scene(*scene(film))
    renderer = session.scene.integrator().prepare(session.scene, session.sensor)
    lidar = renderer.scene
    kernel = lidar.transmitter.pulse.kernel(axis.bin_width_ns, lidar.receiver.optics.response_time_ns)
    energies = [renderer.render_pass(seed).histogram.energy().sum(axis=0) for seed in range(8)]
    power = waveform(np.array(energies), axis.bin_width_ns, kernel)
    shares = np.stack([power[:, :before].sum(axis=1), power[:, before + axis.bin_count :].sum(axis=1)], axis=1)
    mean, error = mean_and_error(shares / power.sum(axis=1).mean())
    assert np.all(mean - largest_z(8, 2) * error < [1e-6, 1e-4])
    # Were it more, this would be seen.
    assert error[1] < 1e-4


@pytest.mark.slow
def test_a_result_keeps_auto_and_lists_the_bins_used():
    first = mitransient_lidar.render("table1", params=SMALL, integrator=FEW, passes=2)
    assert (first.attrs["scene.time_start_ns"], first.attrs["scene.bin_count"]) == ("auto", "auto")
    film = json.loads(first.attrs["plugin_parameters"])["receiver"]["time_gated_film"]
    assert film["bin_count"] == "auto"
    assert film["used"] == {"time_start_ns": first.attrs["time_start_ns"], "bin_count": first.sizes["time"]}
    assert first.attrs["record_end"] == "after the echo of shape 'bottom'"
    again = mitransient_lidar.render(first)
    np.testing.assert_array_equal(again["time"], first["time"])
    np.testing.assert_array_equal(again["waveform"], first["waveform"])


def test_a_number_wins_each_on_its_own():
    flat = {"spectrum": "flat"}
    automatic = prepared("table1", flat).axis
    late = prepared("table1", {**flat, "time_start_ns": 1410.5})
    assert late.axis.start_ns == 1410.5
    assert automatic.end_ns <= late.axis.end_ns < automatic.end_ns + 10
    short = prepared("table1", {**flat, "bin_count": 40})
    assert (short.axis.start_ns, short.axis.bin_count) == (automatic.start_ns, 40)
    both = prepared("table1", {**flat, "time_start_ns": 1390, "bin_count": 150})
    assert (both.axis.start_ns, both.axis.bin_count) == (1390, 150)


def test_water_without_a_visible_bottom():
    """Until the column has fallen to 1e-6, in clear water later, and less far in a narrow view."""
    scenes = ({}, {"jerlov": "I"}, {"field_of_view_mrad": 1, "divergence_mrad": 0.5})
    ends = [prepared("table1", {"spectrum": "flat", "bottom_depth": 300, **params}).axis.end_ns for params in scenes]
    assert ends[2] < ends[0] < ends[1] < 1420 + 300 * 9.6


@pytest.mark.slow
def test_the_record_holds_its_gates():
    gates = {"gate_count": 4, "gate_width_ns": 30.0}
    for start in (1300.0, 1900.0):
        axis = prepared(beside((0, 0, 0), {**gates, "gate_start_ns": start})).axis
        assert axis.start_ns < min(start, 1410) - 10
        assert axis.end_ns > max(start + 120, 1500) + 10


def test_a_scene_without_water():
    """A plate in the air, 20 m above the lowest point, and no light of a sea."""
    transform = mi.ScalarTransform4f()
    plate = {"type": "rectangle", "to_world": transform.translate([0, 0, 20]).scale(50), "bsdf": {"type": "diffuse"}}
    scene = {name: part for name, part in beside((0, 0, 0)).items() if name not in ("sea", "bottom")}
    axis = prepared({**scene, "plate": plate}).axis
    near, far = (2 * 180 / 0.299792458 / np.cos(np.radians(20) + side * 15e-3) for side in (-1, 1))
    assert near - 20 < axis.start_ns < near - 15
    assert far + 15 < axis.end_ns < far + 20


@pytest.mark.slow
@each_case(
    ({"bin_width_ns": 1e-5}, "bin_width_ns = 1e-05 divides the time axis from 139"),
    ({"bin_count": "some"}, "bin_count = 'some' must be a number"),
    ({"bin_count": 5}, "bin_count = 5 bins of 1 ns end the record at 1390 ns: it must end after the surface echo"),
)
def test_invalid_records_are_refused(params, sentence, tmp_path):
    params = {"spectrum": "flat", **params}
    must_refuse(sentence, mitransient_lidar.render, "table1", params=params, passes=2)
    words = [word for name, value in params.items() for word in ("-D", f"{name}={value}")]
    assert_refused(run("render", "table1", "-q", "-o", tmp_path, *words), sentence)
    assert list(tmp_path.iterdir()) == []
