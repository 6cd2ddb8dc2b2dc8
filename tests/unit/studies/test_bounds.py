"""Bounds of designs, and the spread of beams."""

import time

import mitsuba as mi
import numpy as np
import pytest
from command_line import run
from differentiated import PHOTON, result
from rows import each_row, must_refuse, refuses
from significance import largest_z

from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector
from mitransient_lidar.physics.receiver.receiver_files import Channel, ReceiverChannels
from mitransient_lidar.rendering.passes import RenderOptions
from mitransient_lidar.studies import bounds as study
from mitransient_lidar.studies.light_classes import scattering

T = np.arange(60.0)
SMALL = {"spectrum": "flat", "surface_size": 60, "surface_cell_size": 5}


def light(_, *, params, derivatives, passes, seed, instrument=None):
    """Return counts of a decay, whose height is the energy of the pulse; four pixels share its light."""
    RenderOptions(passes=passes, seed=seed)  # refuses what a render would
    random = np.random.default_rng(seed)
    energy, rate = float(params.get("pulse_energy_mj", 5)), float(params.get("attenuation", 0.3))
    pixels = 4 if params.get("layout", "1x1") == "2x2" else 1
    decay = np.stack([100 * energy / pixels * np.exp(-rate * T)] * pixels)
    noise = 1 + 1e-3 * random.normal(size=decay.shape)
    slopes = {"attenuation": -T * decay * noise, "bottom_reflectance": decay * noise, "none": 0 * decay}
    chosen = {name: PHOTON * slopes[name] for name in derivatives}
    return result(PHOTON * (decay + 1), chosen, values={"attenuation": rate})


@pytest.fixture
def rendered(monkeypatch):
    """Replace the renders, and return the list of what is asked for."""
    asked = []

    def render(scene, **options):
        asked.append(options)
        return light(scene, **options)

    monkeypatch.setattr(study, "render", render)
    return asked


@pytest.mark.slow
def test_designs_have_the_same_random_numbers_and_ratios_of_the_root_of_the_energy(rendered):
    """Four times the photons halve the errors of counts, and pixels that share the light change nothing."""
    free, over = ["attenuation", "bottom_reflectance"], {"pulse_energy_mj": [5, 20, 1.25], "layout": ["1x1", "2x2"]}
    nuisances = {"scale": 1e-9, "time_offset": 1e-9}
    options = {"free": free, "over": over, "receiver": "ideal", "passes": 2}
    found = study.bounds("table1", {**SMALL, "attenuation": 0.3}, nuisances=nuisances, **options)
    designs = [(one["params"]["pulse_energy_mj"], one["params"]["layout"]) for one in rendered]
    assert designs == [(energy, layout) for energy in (5, 20, 1.25) for layout in ("1x1", "2x2") for _ in range(4)]
    seeds = [one["seed"] for one in rendered]
    assert seeds == seeds[:4] * 6
    assert len(set(seeds)) == 4
    assert (rendered[0]["derivatives"], rendered[0]["params"]["attenuation"]) == (free, 0.3)
    assert found["bound"].dims == ("design", "parameter")
    assert found["parameter"].values.tolist() == [*free, *nuisances]
    assert found["prior"].values.tolist() == [np.inf, np.inf, 1e-9, 1e-9]
    found = found.isel(parameter=slice(2))
    assert found["design_layout"].values.tolist() == ["1x1", "2x2"] * 3
    # The steady photon of each bin, the photon noise of the tail, matters more at low energies and per pixel.
    ratio = found["ratio"].values.reshape(3, 2, 2)
    assert np.all(ratio[0, 0] == 1)
    np.testing.assert_allclose(ratio[1, 0], 0.5, rtol=0.08)
    np.testing.assert_allclose(ratio[2, 0], 2.0, rtol=0.15)
    assert np.all((ratio[:, 1] > ratio[:, 0]) & (ratio[:, 1] < 1.3 * ratio[:, 0]))
    assert np.all(found["ratio_stderr"][0] == 0)
    assert np.all((found["ratio_stderr"][1:] > 0) & (found["ratio_stderr"][1:] < 1e-2))
    assert np.all(found["bound_stderr"] < 1e-2 * found["bound"])


def test_designs_after_the_time_are_left_out_and_counted(monkeypatch, caplog):
    """Renders take a second each: two designs of two renders begin within 3 s."""
    now = [0.0]

    def render(scene, **options):
        now[0] += 1
        return light(scene, **options)

    monkeypatch.setattr(study, "render", render)
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    energies = {"pulse_energy_mj": [5, 20, 1.25]}
    options = {"free": ["attenuation"], "receiver": "ideal", "passes": 2, "renders": 2}
    found = study.bounds("table1", SMALL, over=energies, max_time=3, **options)
    assert found["design_pulse_energy_mj"].values.tolist() == ["5", "20"]
    assert found.attrs["designs_left_out"] == 1
    assert "max_time = 3 s ended after 2 of 3 designs" in caplog.text
    whole = study.bounds("table1", SMALL, over=energies, **options)
    np.testing.assert_array_equal(found["bound"], whole["bound"][:2])
    assert whole.attrs["designs_left_out"] == 0


def test_receivers_are_compared_on_the_same_renders(rendered):
    """A detector of a quantum efficiency of 0.7 without other noise knows counts to 1/sqrt(0.7) times the error."""
    weak = ReceiverChannels(Channel(ReceiverChain(LinearDetector(0.7))), name="weak")
    options = {"free": ["attenuation"], "over": {"layout": ["1x1", "2x2"]}, "renders": 2}
    found = study.bounds("table1", SMALL, receiver=["ideal", weak], **options)
    assert len(rendered) == 2 * 2
    assert found["design"].values.tolist() == [
        f"layout={layout}, receiver={name}" for layout in ("1x1", "2x2") for name in ("ideal", "weak")
    ]
    ratio = found["bound"].values.reshape(2, 2)
    np.testing.assert_allclose(ratio[:, 1] / ratio[:, 0], 0.7**-0.5, rtol=1e-6)
    np.testing.assert_allclose(found["ratio"].values.reshape(2, 2), ratio / ratio[0, 0], rtol=1e-9)


def test_interrupted_renders_are_not_kept(monkeypatch, tmp_path):
    def render(scene, **options):
        return light(scene, **options).assign_attrs(interrupted=1)

    monkeypatch.setattr(study, "render", render)
    small = [part for name, value in SMALL.items() for part in ("-D", f"{name}={value}")]
    done = run("bounds", "table1", *small, "--free", "attenuation", "-o", tmp_path / "bounds.png", "-q")
    assert done.exit_code == 130
    assert done.stderr == "interrupted after 0 of 4 renders, and none is kept\n"
    assert not list(tmp_path.iterdir())


@each_row(
    ({"free": ["attenuation", "attenuation"]}, "must be a list of different names"),
    ({"over": {"layout": ["1x1", "1x1"]}}, r"over: layout = \['1x1', '1x1'\] must be a list of different values"),
    ({"over": {"layuot": ["1x1"]}}, "layuot"),
    ({"over": {"bin_count": list(range(1001))}}, "over gives 1001 designs: at most 1000"),
    ({"receiver": "eye"}, "receiver = 'eye' must be one of ideal"),
    ({"receiver": ["apd", "apd"]}, r"receiver = \['apd', 'apd'\] must be one receiver, or several with different"),
    ({"receiver": ["apd", "spad"], "gain": "auto"}, "gain = auto needs a receiver with an amplifier, which spad"),
    ({"nuisances": {"phase": 1}}, "nuisance = 'phase' must be one of time_offset, scale"),
)
def test_invalid_input_is_refused_before_a_render(options, message, rendered):
    must_refuse(message, study.bounds, "table1", SMALL, **{"free": ["attenuation"], **options})
    assert not rendered


QUICK = {"passes": 2, "photons": 4096}


@refuses(
    ({}, {"depths": [3, 8.5]}, "depths = 8.5 m must not lie below the bottom, at 8 m"),
    ({}, {"params": {"bottom_depth": 3}}, "params = ['bottom_depth'] need an XML scene"),
    ({"without": ("sea", "bottom")}, {}, "the scene has no water: give its surface a layered_water"),
    ({"without": ("rx",)}, {}, "sensor: the scene has none"),
)
def test_what_is_refused(change, options, lidar_scene):
    receiver = {"type": "multipixel_receiver", "film": {"type": "time_gated_film"}}
    dry = {"tx": {"type": "lidar_transmitter"}, "rx": receiver, "plate": {"type": "rectangle"}}
    given = {name: part for name, part in dry.items() if name not in change["without"]} if change else lidar_scene()
    scattering(given, **{"depths": 2.0, **QUICK, **options})


@pytest.mark.slow
def test_only_what_is_wider_than_the_beam_is_a_bottom(lidar_scene):
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([2, 0, -4]).scale(0.75)}
    scene = lidar_scene(bottom=None, extra={"target": plate})
    found = scattering(scene, depths=6.0, **QUICK)
    without = scattering(lidar_scene(bottom=None), depths=6.0, **QUICK)
    assert 0.1 < float(found["transmitted"].item()) < 0.9 * float(without["transmitted"].item())


@pytest.mark.slow
def test_result():
    spread = scattering("fig09_1x1", {"bottom_depth": 8}, depths=[8, 2.0, 2.0], **QUICK)
    assert spread["depth"].values.tolist() == [2, 8]
    for name, values in spread.data_vars.items():
        assert values.attrs["units"] in ("1", "m", "ns")
        assert np.isfinite(values).all(), name
        if not name.endswith("_stderr"):
            assert (spread[f"{name}_stderr"] > 0).any(), name
    for name in ("within_radius", "within_shift", "within_delay"):
        assert (np.diff(spread[name].values, axis=1) >= 0).all()
        assert (spread[name].values[:, -1] > 0.99).all()
    assert (spread["radius_50"] < spread["radius_90"]).all()
    # Down the slant, 14.788 degrees in the water, through the sea's transmittance of 0.9787; waves change them little.
    slant = np.array([2, 8]) / np.cos(np.radians(14.788))
    np.testing.assert_allclose(spread["unscattered"], 0.9787 * np.exp(-0.3 * slant), rtol=0.05)
    np.testing.assert_allclose(spread["centroid_x"], slant * np.sin(np.radians(14.788)), atol=0.15)
    wanted = {"scene": "fig09_1x1", "seed": 0, "passes": 2, "photons_per_pass": 4096, "scene.bottom_depth": "8"}
    assert wanted.items() <= spread.attrs.items()
    assert spread.attrs["uniform_down_to"] == np.inf


@pytest.mark.slow
@pytest.mark.parametrize("off_nadir", [0.0, 30.0])
def test_share_in_view(lidar_scene, off_nadir):
    # Receiver and laser at one point, no scattering, no ripples to speak of: at every depth the view holds of the
    # Gaussian beam what it holds of it in the air, 1 - exp(-r^2/2) within r standard deviations.
    pose = {"off_nadir_deg": off_nadir}
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": 10.0},
        rx={**pose, "field_of_view_mrad": 12.0, "layout": "2x2"},
        sea={"slope_variance": "2e-5"},
        water={"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0},
    )
    found = scattering(scene, depths=[1.0, 7.0], passes=4, photons=2**14)
    # Photons count as if they were drawn one by one; 0.2 % for the ripples.
    share = 1 - np.exp(-0.5 * 1.2**2)
    error = np.sqrt(share * (1 - share) / (4 * 2**14))
    assert np.abs(found["in_view"] - share).max() < 0.002 + largest_z(10**6, 2) * error
    # Light that is not scattered is neither shifted nor late.
    assert not found["shift_rms"].any()
    assert not found["delay_mean"].any()
    np.testing.assert_allclose(found["transmitted"], found["unscattered"])


def test_beam_outside_the_surface_is_reported(lidar_scene, caplog):
    scene = lidar_scene(sea={"spectrum": "flat", "size": 2.0}, bottom=4.0)
    found = scattering(scene, depths=2.0, **QUICK)
    # Standard deviations of the footprint are 1.064 m across and 1.132 m along, erf(1/(sqrt(2) sigma)) in the patch.
    assert found.attrs["beam_outside_surface"] == pytest.approx(1 - 0.6526 * 0.6230, abs=0.01)
    assert "passes outside it and is left out" in caplog.text
