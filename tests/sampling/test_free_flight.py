"""Free flight and transmittance through layers: exact in every direction, and what NumPy says in double precision."""

import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import kstest

from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.transport.medium.free_flight import LayeredFlight

RNG = np.random.default_rng(4)
COLUMNS = {
    "homogeneous": WaterColumn.from_text(0, 0.3, 0.15, 0.006),
    "two": WaterColumn.from_text("0, 3", "0.9, 0.5", 0.3, 0.006),
    "five": WaterColumn.from_text("0, 0.5, 2, 2.1, 6", "0.2, 1.5, 0.05, 3, 0.4", 0.01, 0.0),
    "thousand": WaterColumn.from_text(np.arange(1000) * 0.01, RNG.uniform(0.1, 2, 1000), 0.05, 0.0),
}
DOWNWARD = [1.0, 0.7, 0.1, 1e-3, 1e-6, 0.0, -1e-6, -1e-3, -0.1, -0.7, -1.0]


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.parametrize("downward", DOWNWARD)
def test_distance_inverts_optical_depth_and_agrees_with_numpy(name, downward):
    column = COLUMNS[name]
    flight = LayeredFlight(column)
    # From a wave crest to far below the last edge.
    depth = np.array([-0.4, 0.0, 0.3, 1.99, 2.05, 3.01, 5.0, 9.0, 30.0])[:, None]
    length = np.array([1e-3, 0.1, 0.7, 2.0, 5.0, 12.0])[None, :]
    depth, length = (a.ravel() for a in np.broadcast_arrays(depth, length))
    depth = depth.astype(np.float32).astype(np.float64)
    reference = column.optical_depth(depth, depth + downward * length, length)
    optical_depth = flight.optical_depth(mi.Float(depth), mi.Float(downward), mi.Float(length))
    # Float32 places an edge to 1e-6 m, which a ray sees 1 / |downward| as long, but never longer than itself.
    blur = np.minimum(4e-6 / max(abs(downward), 1e-9), length) * column.attenuation.max()
    np.testing.assert_array_less(np.abs(np.array(optical_depth) - reference), 2e-6 + 3e-6 * reference + blur)
    distance = np.array(flight.distance(mi.Float(depth), mi.Float(downward), optical_depth))
    least = column.attenuation.min()
    np.testing.assert_array_less(np.abs(distance - length), (4e-6 + 1e-5 * reference + 2 * blur) / least + 1e-6)


@pytest.mark.parametrize("downward", [1.0, 0.3, -0.6])
def test_sampled_distances_follow_the_transmittance(downward):
    column = COLUMNS["five"]
    flight = LayeredFlight(column)
    count = 200_000
    rng = mi.PCG32(count, initstate=3)
    uniform = np.array(rng.next_float32(), dtype=np.float64)
    optical_depth = mi.Float(-np.log1p(-uniform))
    distance = np.array(flight.distance(mi.Float(4.0), mi.Float(downward), optical_depth), dtype=np.float64)

    def cumulative(s):
        s = np.asarray(s)
        return -np.expm1(-column.optical_depth(4.0, 4.0 + downward * s, s))

    assert kstest(distance, cumulative).pvalue > 1e-3


def test_clear_water_is_never_left_by_scattering():
    flight = LayeredFlight(WaterColumn.from_text(0, 0, 0, 0))
    assert np.isinf(np.array(flight.distance(mi.Float(1.0), mi.Float(1.0), mi.Float(0.5))))[0]
    assert np.array(flight.optical_depth(mi.Float(1.0), mi.Float(1.0), mi.Float(50.0)))[0] == 0


def test_layer_lookup_owns_upper_edges():
    flight = LayeredFlight(COLUMNS["five"])
    depth = np.array([-1, 0, 0.49, 0.5, 1.99, 2.0, 2.1, 5.9, 6.0, 100])
    layers = np.array(flight.layer_at(mi.Float(depth)))
    assert layers.tolist() == [0, 0, 0, 1, 1, 2, 3, 3, 4, 4]
    np.testing.assert_allclose(np.array(flight.albedo(mi.UInt32(layers))), COLUMNS["five"].albedo[layers], rtol=1e-6)
