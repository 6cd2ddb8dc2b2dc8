"""A user's table of a phase function: what it was made from comes back, sampled into the forward peak."""

import mitsuba as mi
import numpy as np
import pytest
import significance
from oracles.phase import henyey_greenstein
from significance import largest_z

G = 0.9
WI = np.array([0.3, -0.5, 0.8124]) / np.linalg.norm([0.3, -0.5, 0.8124])


@pytest.fixture
def table(tmp_path):
    """Henyey-Greenstein at 400 uneven angles, as a volume scattering function of b = 0.4 /m."""
    angle = np.concatenate([np.geomspace(0.05, 10, 200), np.linspace(10.4, 180, 200)])
    path = tmp_path / "measured.csv"
    value = 0.4 * henyey_greenstein(np.radians(angle), G)
    path.write_text("angle, vsf\n" + "\n".join(f"{a:.6f}, {v:.8g}" for a, v in zip(angle, value, strict=True)))
    return str(path)


def interaction():
    mei = mi.MediumInteraction3f()
    mei.wi = mi.Vector3f(WI.tolist())
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei


def test_samples_and_values_are_those_of_the_function_in_the_table(table, caplog):
    plugin = mi.load_dict({"type": "measured_phase", "filename": table})
    assert "the values integrate to 0.4 over the sphere" in caplog.text
    assert plugin.backscatter_ratio == pytest.approx(0.022903, rel=5e-3)
    count = 400_000
    rng = mi.PCG32(count, initstate=3 + significance.seed_shift)
    first, pair = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    wo, weight, pdf = plugin.sample(mi.PhaseFunctionContext(), interaction(), first, pair)
    cosine = -(np.array(wo).T @ WI)
    assert np.all(np.array(weight) == 1)
    error = cosine.std() / np.sqrt(count)
    # The opposite orientation would give -0.9; a table read in radians nothing like it.
    # 3e-4 for the table, whose first angle is 0.05 degrees.
    assert abs(cosine.mean() - G) < largest_z(count) * error + 3e-4
    expected = henyey_greenstein(np.arccos(np.clip(cosine, -1, 1)), G)
    np.testing.assert_allclose(np.array(pdf), expected, rtol=0.02)
    value, density = plugin.eval_pdf(mi.PhaseFunctionContext(), interaction(), wo)
    np.testing.assert_allclose(np.array(value)[0], np.array(density))


def test_invalid_input_is_refused(tmp_path):
    with pytest.raises(RuntimeError, match="filename is missing"):
        mi.load_dict({"type": "measured_phase"})
    path = tmp_path / "short.csv"
    path.write_text("0.1, 5\n90, 1\n180, 0.5\n")
    with pytest.raises(RuntimeError, match="10"):
        mi.load_dict({"type": "measured_phase", "filename": str(path)})
