"""Numbers outside their ranges: every function refuses them, and numbers that are none, with name and value."""

import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.axis_limits import system_attenuation
from mitransient_lidar.physics.lidar.clear_sky import background_power, clear_sky_irradiance
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.physics.lidar.level_sea import LidarSystem, snell
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SiliconPhotomultiplier, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser, LogAmplifier
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS
from mitransient_lidar.physics.receiver.shot_jitter import ShotJitter
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.kelvin_wake import kelvin_wake
from mitransient_lidar.physics.sea.realization import angular_frequency, wave_numbers
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum
from mitransient_lidar.physics.sea.wind_spectra import (
    ElfouhailySpectrum,
    JonswapSpectrum,
    PiersonMoskowitzSpectrum,
    SwellSpectrum,
    inverse_wave_age,
)
from mitransient_lidar.physics.water.bubbles import WindBubbles
from mitransient_lidar.physics.water.phase import (
    fournier_forand,
    fournier_forand_parameters,
    henyey_greenstein_backscatter_ratio,
)
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.seawater import (
    group_index,
    refractive_index,
    water_absorption,
    water_phase_function,
    water_scattering,
)
from mitransient_lidar.physics.water.sediments import HapkeSurface
from mitransient_lidar.physics.water.water_types import InherentProperties, chlorophyll, from_kd, from_secchi, jerlov

TRAIN = {"start_ns": 1400.0, "width_ns": 10.0, "step_ns": 5.0, "count": 3}
SYSTEM = {"height": 200, "off_nadir": 0.3, "refractive_index": 1.34, "group_index": 1.364}
APD = {"power": np.array([1e-9]), "bin_width_ns": 1.0, "shots": 1, "seed": 1}
WAKE = {"x": [0, 1], "y": [0, 1], "speed": 5, "bearing": 0, "length": 10}
WIND = ElfouhailySpectrum(5)
ANY = np.nan

#: Functions, valid arguments, and values outside the ranges of these and of others; ANY is refused by all.
RANGES = [
    (
        clear_sky_irradiance,
        {"zenith_deg": 10.0},
        {"zenith_deg": 90.0, "aerosol_optical_depth": -1.0, "angstrom_exponent": 4.0, "ozone_cm": 3.0},
    ),
    (clear_sky_irradiance, {"zenith_deg": 10.0}, {"pressure_hpa": ANY}),
    (background_power, {"radiance": 0.01, "etendue": 1e-8}, {"filter_width_nm": 0}),
    (GateTrain, TRAIN, {"start_ns": ANY, "width_ns": 0, "step_ns": -1, "count": 2.5, "rise_ns": -1, "pulses": 0}),
    (LidarSystem, {**SYSTEM, "energy": 1, "aperture_area": 1}, {"height": 0, "off_nadir": 1.6}),
    (LidarSystem, {**SYSTEM, "energy": 1, "aperture_area": 1}, {"refractive_index": 0.9, "group_index": 0.9}),
    (Pulse.gaussian, {}, {"fwhm_ns": 0}),
    (Pulse.gaussian(5).kernel, {"bin_width_ns": 1}, {"bin_width_ns": 0, "response_time_ns": -1}),
    (snell, {"theta": 0.1, "n": 1.34}, {"theta": ANY, "n": 0.9}),
    (
        system_attenuation,
        {"attenuation": 0.3, "kd": 0.1, "spot_diameter": 1},
        {"attenuation": -0.1, "kd": ANY, "spot_diameter": -2},
    ),
    (LinearDetector, {"quantum_efficiency": 0.5}, {"quantum_efficiency": 1.2, "gain": 0.5, "leakage_current_na": -1}),
    (
        LinearDetector.avalanche,
        {"quantum_efficiency": 0.5, "gain": 10.0, "ionisation_ratio": 0.1},
        {"ionisation_ratio": 1.5},
    ),
    (
        LinearDetector.photomultiplier,
        {"quantum_efficiency": 0.2, "dynode_gains": (5.0,)},
        {"quantum_efficiency": 0, "largest_current_ma": 0},
    ),
    (
        SiliconPhotomultiplier,
        {"quantum_efficiency": 0.4, "cells": 10, "recovery_time_ns": 10.0},
        {"cells": 0, "crosstalk": 0.7},
    ),
    (
        SinglePhotonDetector,
        {"quantum_efficiency": 0.5, "dead_time_ns": 10.0},
        {"quantum_efficiency": 0, "afterpulse_probability": 0.6, "afterpulse_decay_ns": -1},
    ),
    (
        Amplifier,
        {"transimpedance_ohm": 1.0},
        {"transimpedance_ohm": 0, "noise_pa_per_rthz": -1, "bandwidth_mhz": 0, "limit_v": ANY, "coupling_ns": 0},
    ),
    (Amplifier, {"transimpedance_ohm": 1.0, "limit_v": 1.0}, {"recovery_ns": -2}),
    (LogAmplifier, {"volts_per_decade": 0.3, "knee_v": 1e-3}, {"knee_v": 0}),
    (
        Digitiser,
        {"bits": 8, "full_scale_v": 1.0},
        {"bits": 0, "full_scale_v": -1, "sampling_ghz": 0, "block_threshold_v": 0},
    ),
    (Digitiser, {"bits": 8, "full_scale_v": 1.0, "block_threshold_v": 0.1}, {"block_before": -1}),
    (ReceiverChain, {"detector": LinearDetector(0.6)}, {"wavelength_nm": 0}),
    (RECEIVERS["apd"].apply, APD, {"power": [-1e-9], "shots": 0, "seed": -1, "background": -1e-9}),
    (RECEIVERS["apd"].apply, APD, {"power": [ANY], "bin_width_ns": 0}),
    (ShotJitter, {}, {"energy_rms": 1.5, "trigger_ns": -0.1, "clock_ns": ANY}),
    (cox_munk, {}, {"wind_speed": -1}),
    (wave_numbers, {"period": 10, "cells": 16}, {"period": -1}),
    (angular_frequency, {"k": 1.0}, {"depth": -1}),
    (
        kelvin_wake,
        WAKE,
        {"speed": 0, "bearing": np.inf, "length": -2, "beam": 0, "draught": -0.1, "ship_x": ANY, "ship_y": ANY},
    ),
    (kelvin_wake, WAKE, {"smallest_wavelength": 0, "x": [0, ANY]}),
    (ElfouhailySpectrum, {"wind_speed": 5}, {"wind_speed": 31, "inverse_wave_age": 0.5, "direction": np.inf}),
    (PiersonMoskowitzSpectrum, {"wind_speed": 1}, {"wind_speed": -1, "direction": ANY}),
    (inverse_wave_age, {"wind_speed": 5, "fetch": 1e4}, {"fetch": 0}),
    (
        JonswapSpectrum,
        {"wind_speed": 10, "fetch": 1e4},
        {"wind_speed": 0, "fetch": -1, "peak_enhancement": 0.9, "direction": ANY},
    ),
    (
        SwellSpectrum,
        {"height": 1, "wavelength": 20},
        {"height": -1, "wavelength": 0, "direction": ANY, "relative_bandwidth": 0.4, "directional_spread": 0.7},
    ),
    (
        MatchedSpectrum,
        {"spectrum": WIND, "upwind": 0.1, "crosswind": 0.1},
        {"upwind": -0.1, "crosswind": ANY, "k_from": 0},
    ),
    (WindBubbles.of_wind, {}, {"wind_speed": 25}),
    (fournier_forand, {"theta": 1.0, "n": 1.1, "mu": 3.5}, {"n": 1.0, "mu": 5.0}),
    (fournier_forand_parameters, {}, {"backscatter_ratio": 0.5}),
    (fournier_forand_parameters, {}, {"backscatter_ratio": 0.0}),
    (henyey_greenstein_backscatter_ratio, {}, {"g": 1}),
    (PowerLawTable.from_function(np.ones_like).with_chi, {}, {"chi": 0}),
    (PowerLawTable.from_values, {"values": [1.0, 1.0]}, {"log_s0": 1}),
    (refractive_index, {"wavelength_nm": 532}, {"wavelength_nm": 399, "temperature": 31, "salinity": 41}),
    (group_index, {"wavelength_nm": 532}, {"wavelength_nm": 1101, "temperature": -1}),
    (water_absorption, {}, {"wavelength_nm": 1550}),
    (water_scattering, {"wavelength_nm": 532}, {"salinity": 41, "depolarisation": 0.3}),
    (water_phase_function, {"theta": 0}, {"depolarisation": -0.1}),
    (
        HapkeSurface,
        {"albedo": 0.5},
        {"albedo": -0.1, "lobe_asymmetry": -0.1, "backward_share": -0.1, "opposition_amplitude": -0.1},
    ),
    (
        InherentProperties,
        {"absorption": 0.1, "scattering": 0.1, "backscattering": 0},
        {"absorption": -0.1, "scattering": ANY},
    ),
    (jerlov, {"water_type": "II"}, {"wavelength_nm": 450}),
    (chlorophyll, {"concentration": 1}, {"concentration": 0, "wavelength_nm": 390}),
    (from_kd, {"kd": 0.1}, {"kd": 0.04}),
    (from_secchi, {"depth": 5}, {"depth": 30}),
]


@each_row(
    *[
        pytest.param(function, {**valid, name: value}, name, id=f"{function.__qualname__} {name}")
        for function, valid, outside in RANGES
        for name, value in outside.items()
    ]
)
def test_numbers_outside_their_range_are_refused_by_name(function, arguments, name):
    given = np.asarray(arguments[name])
    for wrong in (given, np.full(given.shape, np.nan)):
        with pytest.raises(UserError) as error:
            function(**{**arguments, name: wrong.tolist()})
        shown = f"{wrong.ravel()[-1]:g}"
        assert str(error.value).startswith((f"{name} = {shown} must ", f"{name} holds {shown} "))
