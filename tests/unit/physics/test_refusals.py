"""Numbers that fit no other, parts that need another, and lists that are none: each is refused in one sentence."""

import numpy as np
from rows import refuses

from mitransient_lidar.physics.lidar.gate_train import GateShape, GateTrain
from mitransient_lidar.physics.lidar.pulse import Pulse, waveform
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser, LogAmplifier
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS
from mitransient_lidar.physics.receiver.sample_moments import sample_moments
from mitransient_lidar.physics.sea.kelvin_wake import kelvin_wake
from mitransient_lidar.physics.sea.realization import wave_numbers
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum, SeaState
from mitransient_lidar.physics.sea.wind_spectra import JonswapSpectrum, SwellSpectrum
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.profiles import Profile
from mitransient_lidar.physics.water.water_types import InherentProperties, jerlov

DIODE, PULSE = LinearDetector(0.6), np.ones(24)


def photons(**values):
    return SinglePhotonDetector(0.5, 10.0, **values)


def moments(power, directions):
    return sample_moments(RECEIVERS["ideal"], power, directions, 1.0)


def wake(**changes):
    return kelvin_wake(**{"x": [0, 1], "y": [0, 1], "speed": 5, "bearing": 0, "length": 10, **changes})


def layers(tolerance):
    return Profile([1, 2], [0.2, 0.2], [0.1, 0.1], [0.002, 0.002]).layers(tolerance)


TAIL = {"tail_fractions": (0.1,), "tail_decays_ns": (9.0,)}
REFUSED = [
    (lambda: Pulse.sampled([0, 1, 1], [0, 1, 0]), "must increase strictly"),
    (lambda: Pulse.sampled([0, 1], [0, -1]), "power = -1 must not be negative"),
    (lambda: Pulse.sampled([0, 1], [0, 0]), "power must be greater than 0 somewhere"),
    (lambda: Pulse.sampled([0], [1]), r"times_ns of shape \(1,\) must be a list of at least 2"),
    (lambda: waveform(1.0, 1.0, (0, np.ones(1))), "time axis"),
    (lambda: GateTrain(1400.0, 10.0, 5.0, 3, 6, 6.1), "must add up to at most 11.8"),
    (
        lambda: GateTrain(1400.0, 10.0, 5.0, 3, profile=GateShape.sampled([0, 1], [1, 1])),
        "must be those of the profile",
    ),
    *((lambda g=g: GateShape.sampled([0, 1], g), "must lie between 0 and 1") for g in ([0, 1.1], [-0.1, 1])),
    (lambda: GateShape.sampled([0, 1], [0, 0]), "greater than 0 somewhere"),
    (lambda: TimeAxis.covering(1396.2, 1552.0, 1e-5), r"bin_width_ns = 1e-05 .* at least 0\.00016"),
    (lambda: ReceiverChain(DIODE, digitiser=Digitiser(8, 1.0)), "digitiser needs an amplifier"),
    (lambda: ReceiverChain(DIODE, logarithm=LogAmplifier(0.2, 1e-3)), "logarithm needs an amplifier"),
    (lambda: ReceiverChain(photons(), Amplifier(1.0)), "SinglePhotonDetector, which outputs counts"),
    (lambda: RECEIVERS["apd"].apply(1.0, 1.0, 1, 1), "time axis"),
    (lambda: RECEIVERS["apd"].apply([1e-9], 1.0, 1, 1, [1e-9, 1e-9]), r"background of shape \(2,\)"),
    (lambda: LinearDetector.photomultiplier(0.2, [4.0, 1.0]), "dynode_gains"),
    (lambda: SinglePhotonDetector(0.5, 0.5).moments(np.ones(3), 1.0, 1), r"dead_time_ns = 0\.5 .* narrower bins"),
    (lambda: photons(afterpulse_probability=0.1), "afterpulse_decay_ns is required"),
    (
        lambda: photons(afterpulse_probability=0.1, afterpulse_decay_ns=9.0, paralyzable=True),
        "must be 0 for a paralyzable",
    ),
    (lambda: photons(tail_fractions=(0.1,)), r"tail_decays_ns = \[\] must have as many numbers as tail_fractions, 1"),
    (lambda: photons(tail_fractions=(0.7, 0.6), tail_decays_ns=(9.0, 8.0)), "tail_fractions .* a sum of at most 1"),
    (lambda: photons(**TAIL, tail_delays_ns=(1.0, 2.0)), "tail_delays_ns = .* must have as many"),
    (lambda: Digitiser(8, 1.0, block_after=5), "block_after = 5 needs block_threshold_v"),
    (lambda: Amplifier(1.0, response="boxcar"), "response = 'boxcar'"),
    (lambda: moments(-PULSE, PULSE[None]), "power = -1 must not be negative"),
    (lambda: moments(PULSE[None], PULSE[None]), r"power of shape \(1, 24\) must be one record"),
    (lambda: moments(PULSE, PULSE), r"directions of shape \(24,\) must have shape \(direction, 24\)"),
    (lambda: moments(PULSE, np.nan * PULSE[None]), "directions holds nan"),
    (lambda: wake(x=[1.0]), r"x of shape \(1,\) must be a list of at least 2 numbers"),
    (lambda: wake(y=[[0, 1]]), r"y of shape \(1, 2\) must be a list of at least 2 numbers"),
    (lambda: wake(y=[0, 2, 2]), "y must increase strictly, but 2 is followed by 2"),
    (lambda: wake(x=[0, 0.05], y=[0, 0.05], ship_x=1e6), r"wake_x, wake_y: .* over 3.54e\+05 m .* too far"),
    *((lambda cells=cells: wave_numbers(10, cells), f"cells = {cells} must be") for cells in (0, 15)),
    (lambda: JonswapSpectrum(10, 0.5), "fetch = 0.5 must be at least 1.02 m at a wind speed of 10 m/s"),
    (lambda: SwellSpectrum(2, 20), "height = 2 must not exceed 1.33 m, a fifteenth of the wavelength"),
    (lambda: SeaState(()), "components must hold at least one"),
    (lambda: SeaState((3,)), "components holds 3 but every component must be a wave spectrum"),
    (lambda: MatchedSpectrum(SwellSpectrum(1, 20), 0.1, 0.1), "spectrum = SwellSpectrum.* must be one of wind"),
    (lambda: PowerLawTable.from_function(np.ones_like).with_chi(0.001), "chi_p = 0.001 makes .* negative: .* than"),
    (lambda: PowerLawTable.from_values([1.0, 0.0, 1.0]), "greater than 0 at every node"),
    (lambda: PowerLawTable.from_values([1.0, np.nan]), "nan"),
    (lambda: PowerLawTable.from_values([1e30, 1.0], -20.0), "exponent must be below 1"),
    *((lambda value=value: layers(value), "tolerance = ") for value in (0, 0.6, np.nan)),
    (lambda: InherentProperties(0.1, 0.1, 0.2), r"backscattering = 0\.2 must not exceed scattering = 0\.1"),
    (lambda: InherentProperties(0.1, 0.1, 0.01, 0.03), r"water_scattering = 0\.03 must not exceed .* twice back"),
    (lambda: jerlov("IV"), "water_type = 'IV' must be one of I, IA, IB, II, III, 1C, 3C, 5C, 7C, 9C"),
]


@refuses(*REFUSED)
def test_what_does_not_fit_is_refused_in_one_sentence(call):
    call()
