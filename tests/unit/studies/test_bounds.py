"""Bounds of designs from closed-form light in place of renders: ratios, table, figures and the command."""

import time

import numpy as np
import pytest
from command_line import run
from differentiated import PHOTON, result
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector
from mitransient_lidar.physics.receiver.receiver_files import Channel, ReceiverChannels
from mitransient_lidar.rendering.passes import RenderOptions
from mitransient_lidar.studies import bounds as study

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
    with pytest.raises(UserError, match=message):
        study.bounds("table1", SMALL, **{"free": ["attenuation"], **options})
    assert not rendered
