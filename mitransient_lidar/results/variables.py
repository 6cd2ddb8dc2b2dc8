"""Registry of the variables of all datasets: unit and long name (CF-1.11) of each, in one place.

`label` describes the variables of a dataset by their names. Standard errors and limits follow from what they are of. A
name of several meanings has an entry for each kind of dataset, ``kind.name``.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Any

import xarray as xr

_IN_BEAM = "mean over the beam's footprint"
_OF_WATER = "of the water, mean from the mean sea level to the bottom"
_PER_PARAMETER = "unit of the parameter, see parameter_units"
_RADIANCE = "W m-2 sr-1 nm-1"

#: Unit, empty for texts, and long name.
VARIABLES: dict[str, tuple[str, str]] = {
    # records of light, and their coordinates
    "impulse_response": ("J", "received energy per time bin"),
    "waveform": ("W", "received power"),
    "waveform_batch": ("W", "received power by a batch of passes"),
    "error_correlation": ("1", "mean correlation of the errors of the waveform's bins in two blocks"),
    "error_time": ("ns", "middle of a block of bins"),
    "other_error_time": ("ns", "middle of a block of bins"),
    "time": ("ns", "time at the centre of the bin since the pulse's peak left the transmitter"),
    "flight.time": ("ns", "time from the start of the record of the shot, centres of samples"),
    "pixel": ("", "pixel name"),
    "points.pixel": ("1", "number of the pixel, from 0"),
    "row": ("1", "row of the image, 0 farthest from nadir"),
    "column": ("1", "column of the image, 0 leftmost as seen from the lidar"),
    "angle_x": ("mrad", "angle of the pixel's centre in the plane of incidence, away from nadir"),
    "angle_y": ("mrad", "angle of the pixel's centre across the plane of incidence, to the left"),
    "shot": ("1", "number of the shot"),
    "campaign.shot": ("1", "number of the shot over the sea of the run"),
    "points.shot": ("1", "number of the pulse, from 0"),
    "shot_passes": ("1", "number of passes of the shot"),
    "batch_passes": ("1", "number of passes of the batch"),
    "place_passes": ("1", "passes"),
    "origin": ("", "where the light comes from"),
    "sight_x": ("mrad", "angle of the line of sight in the plane of incidence, away from nadir"),
    "sight_y": ("mrad", "angle of the line of sight across the plane of incidence"),
    "off_nadir": ("degree", "angle of the line of sight from the vertical in air"),
    "surface_time": ("ns", "arrival of the echo of the mean sea level along the line of sight"),
    "surface_spread": ("ns", "standard deviation of that arrival over the pixel's direct light"),
    "depth_per_ns": ("m ns-1", "depth per delay along the line of sight"),
    "beam_share": ("1", "share of the beam's energy in the pixel"),
    # parameters of scenes: derivatives, bounds and fits
    "parameter": ("", "parameter of the scene"),
    "other_parameter": ("", "parameter of the scene"),
    "parameter_value": ("", "value of the parameter"),
    "parameter_units": ("", "unit of the parameter"),
    "parameter_method": ("", "estimate of the derivative"),
    "prior": (_PER_PARAMETER, "known to"),
    "bound": (_PER_PARAMETER, "least standard deviation of an estimate"),
    "bound_known": (_PER_PARAMETER, "least standard deviation with all other parameters known"),
    "bound_left_out": (_PER_PARAMETER, "bound without one of the renders"),
    "variance_share": ("1", "share of the information in the variance of the samples"),
    "monte_carlo_share": ("1", "information by the noise of the render, relative to the true one"),
    "information": ("1/(unit of one parameter x unit of the other)", "Fisher information"),
    "correlation": ("1", "correlation of the estimates"),
    "lost_samples": ("1", "share of samples that saturate"),
    "measured": ("", "measured waveform"),
    "fitted": ("", "fitted waveform"),
    "fitted_stderr": ("", "standard error of the fitted waveform by Monte Carlo"),
    "ratio": ("1", "bound over that of the first design"),
    "remarks": ("", "what a record does not determine"),
    "residual": ("1", "measured less fitted, in standard deviations"),
    "used": ("1", "sample that was fitted"),
    # gates and images
    "gate": ("1", "number of the gate"),
    "gate_energy": ("J", "energy collected while the gate is open"),
    "gate_energy_derivative": (
        "J per unit of the parameter",
        "derivative of the energy collected while the gate is open",
    ),
    "gate_start": ("ns", "half height of the gate's rising edge"),
    "gate_width": ("ns", "time between the half heights of the gate"),
    "gate_depth": ("m", "depth of the middle of the gate on the axis"),
    "frame": ("1", "frame number"),
    "time_s": ("s", "time since the first frame"),
    "flight.time_s": ("s", "time of the pulse"),
    "radiance": (_RADIANCE, "spectral radiance, mean over the pixel"),
    "etendue": ("m2 sr", "open area times solid angle times transmittance"),
    "background_power": ("W", "detected power of the daylight"),
    # truth of shots
    "aim_x": ("m", "place where the axis meets the mean sea level, x"),
    "aim_y": ("m", "place where the axis meets the mean sea level, y"),
    "true_slope_along": ("1", f"slope of the surface, {_IN_BEAM}, positive for a face towards the lidar"),
    "true_slope_across": ("1", f"slope of the surface, {_IN_BEAM}, positive for a rise to the left"),
    "true_surface_height": ("m", f"height of the surface above the mean sea level, {_IN_BEAM}"),
    "true_bottom_depth": ("m", "depth of the bottom below the mean sea level where the refracted axis meets it"),
    "true_bottom_depth_below_surface": ("m", "depth of that point below the mean surface in the beam's footprint"),
    "true_absorption": ("1/m", f"absorption coefficient a {_OF_WATER}"),
    "true_scattering": ("1/m", f"scattering coefficient b {_OF_WATER}"),
    "true_backscattering": ("1/m", f"backscattering coefficient bb {_OF_WATER}"),
    "true_attenuation": ("1/m", f"beam attenuation coefficient c {_OF_WATER}"),
    "true_kd": ("1/m", f"diffuse attenuation coefficient Kd {_OF_WATER}"),
    # signals of receivers, in the unit of the record
    "signal": ("V", "recorded signal"),
    "saturated": ("1", "sample at a limit of amplifier or digitiser"),
    "signal_mean": ("V", "mean of the recorded signal"),
    "signal_mean_stderr": ("V", "standard error of the mean signal by the Monte Carlo of the render"),
    "signal_deviation": ("V", "standard deviation of the recorded signal of a shot"),
    "snr": ("1", "signal-to-noise ratio of a shot"),
    "saturation": ("1", "probability that a sample is saturated"),
    "saturated_shots": ("1", "share of shots with saturated samples"),
    "saturated_samples": ("1", "share of saturated samples"),
    "dark_level": ("V", "mean signal without light of the pulse"),
    "block_level": ("V", "signal above which samples are stored"),
    "lag": ("ns", "delay of the sample"),
    "receiver_response": ("1", "weight of the light of a bin in a sample"),
    "event_height": ("V", "height that a single event exceeds in one of a thousand records"),
    "gain": ("1", "factor of the amplifier's transimpedance"),
    "optical_density": ("1", "optical density of the filter"),
    # echoes
    "echo": ("", "kind of echo"),
    "estimator": ("", "estimator of the echo's time"),
    "time_ns": ("ns", "arrival of the echo"),
    "depth_m": ("m", "depth of the echo below the local surface"),
    "mean.depth_m": ("m", "depth of the echo below the mean sea level"),
    "depth_m_method_error": ("m", "typical error of the depth by scattering and the light's distribution"),
    "depth_correction_m": ("m", "mean error that was subtracted from the depth"),
    "amplitude": ("W", "height of the echo"),
    "energy": ("J", "integral of the echo over time"),
    "width_ns": ("ns", "full width of the echo at half maximum"),
    "flags": ("1", "problems of the echo"),
    "surface_time_ns": ("ns", "arrival of the surface"),
    "surface_time_ns_method_error": (
        "ns",
        "error by the few places that return light, of the arrival of the surface",
    ),
    "attenuation": ("1/m", "effective attenuation of the column along the path"),
    "attenuation_chi2": ("1", "squared residuals of the column's fit over its degrees of freedom"),
    "column_start_ns": ("ns", "time from which on samples count for the column"),
    "column_end_ns": ("ns", "time up to which samples count for the column"),
    "layer_depth_m": ("m", "depth of a change in the column"),
    "layer_p_value": ("1", "probability that noise causes as strong a change"),
    "layer_step": ("1", "logarithm of the signal below the change over that above it"),
    "layer_attenuation_above": ("1/m", "attenuation above the change along the path"),
    "layer_attenuation_below": ("1/m", "attenuation below the change along the path"),
    # depth errors and uncertainties
    "off_nadir_deg": ("degree", "angle from nadir"),
    "wind_speed": ("m s-1", "wind speed"),
    "ripples": ("m s-1", "wind whose ripples the sea has"),
    "altitude": ("m", "height of the lidar above the mean sea level"),
    "depth": ("m", "depth below the mean sea level"),
    "bias": ("m", "mean error of the depth below the local surface"),
    "spread": ("m", "standard deviation of that error"),
    "found": ("1", "share of shots with a depth"),
    "noise_error": ("m", "median of the stated error by noise"),
    "error": ("m", "median of the stated error"),
    "z": ("1", "root mean square of error over stated error"),
    "wrong": ("1", "share of shots with an error above 0.5 m and no flag"),
    "flagged": ("1", "share of shots with a depth and a flag"),
    "bright": ("1", "share of shots whose largest signal-to-noise ratio within 0.5 m of the bottom is above 10"),
    "bright_found": ("1", "share of shots with a depth among the bright ones"),
    "hidden": ("1", "share of shots that are bright and have a depth only where errors of the render are no noise"),
    "corrected_bias": ("m", "bias after correction"),
    "corrected_spread": ("m", "standard deviation after correction"),
    "corrected_z": ("1", "root mean square of error over stated error after correction"),
    "bias.snr": ("1", "median over shots of the largest signal-to-noise ratio within 0.5 m of the bottom"),
    "bias.slope_along": ("1", "root mean square over shots of the slope in the line of sight, mean over the beam"),
    "bias.slope_across": ("1", "root mean square over shots of the slope across the line of sight, mean over the beam"),
    "subaqueous_vertical": ("m", "standard deviation of the depth below the sea, its bias in quadrature"),
    "subaqueous_horizontal": ("m", "standard deviation of the place on the bottom by waves and footprint, one axis"),
    "stated": ("m", "median of the stated error of the depth, one standard deviation"),
    "tvu": ("m", "total vertical uncertainty at 95 %, errors of the trajectory included"),
    "thu": ("m", "total horizontal uncertainty at 95 %, errors of the trajectory included"),
    "order": ("1", "strictest order of S-44 that is met"),
    "channel": ("1", "channel with the smallest uncertainty"),
    "vertical_a": ("m", "constant part a of the fit sqrt(a^2 + (b d)^2) to subaqueous_vertical"),
    "vertical_b": ("1", "part b by depth of the fit sqrt(a^2 + (b d)^2) to subaqueous_vertical"),
    "vertical_residual": ("m", "subaqueous_vertical less its fit"),
    "horizontal_a": ("m", "constant part a of the fit a + b d to subaqueous_horizontal"),
    "horizontal_b": ("1", "part b by depth of the fit a + b d to subaqueous_horizontal"),
    # retrieval
    "slope_along": ("1", "slope of the surface along the lidar's azimuth, positive for a face towards the lidar"),
    "slope_across": ("1", "slope of the surface across the lidar's azimuth, positive for a rise to the left"),
    "slope_deg": ("degree", "angle of the surface from the horizontal"),
    "slope_direction_deg": ("degree", "direction of the rise from the lidar's azimuth"),
    "surface_range": ("m", "distance to the surface along the axis"),
    "surface_height": ("m", "height of the surface above the mean sea level"),
    "plane_misfit": ("ns", "deviation of the echoes from a plane"),
    "slope_refused": ("1", "1 where a slope is steeper than the sea"),
    "bottom_energy": ("J", "energy of the bottom echo"),
    "column_attenuation": ("1/m", "attenuation of the column's signal along the path"),
    "absorption": ("1/m", "absorption coefficient"),
    "backscattering": ("1/m", "backscattering coefficient"),
    "kd": ("1/m", "diffuse attenuation coefficient"),
    "water.attenuation": ("1/m", "beam attenuation coefficient for the typical bb/b"),
    "attenuation_low": ("1/m", "smallest beam attenuation coefficient"),
    "attenuation_high": ("1/m", "largest beam attenuation coefficient"),
    "reflectance": ("1", "reflectance of the bottom"),
    "reflectance_stderr": ("1", "error of the reflectance by the sea, noise and method"),
    "reflectance_corrected": ("", "correction of the reflectance applied"),
    "reflectance_flags": ("", "reasons for which the reflectance is not given"),
    "bottom.depth_m": ("m", "depth of the bottom below the mean sea level"),
    "bottom.depth_m_stderr": ("m", "error of the depth by the sea, noise and method"),
    "depth_corrected": ("", "correction of the depth applied"),
    "class_probability": ("1", "probability of the bottom's class"),
    # studies of light
    "field_of_view": ("mrad", "full angle of the field of view"),
    "effective_attenuation": ("1/m", "attenuation coefficient of the column"),
    "spot_radius": ("m", "radius of the circle that the receiver sees on the surface"),
    "scaled_radius": ("1", "beam attenuation times spot radius"),
    "system_attenuation": ("1/m", "fit to Gordon's results"),
    "orders.energy": ("J", "received energy"),
    "orders.order": ("", "scattering events; the last, and more"),
    "spread.depth": ("m", "depth below the mean sea level"),
    "radius": ("m", "horizontal distance"),
    "delay": ("ns", "delay by scattering"),
    "transmitted": ("1", "share of the pulse energy that passes the depth downwards"),
    "unscattered": ("1", "share of the pulse energy that passes the depth unscattered"),
    "in_view": ("1", "share of the light at the depth that is in the field of view"),
    "centroid_x": ("m", "mean x of the light"),
    "centroid_y": ("m", "mean y of the light"),
    "radius_rms": ("m", "root-mean-square distance from the centroid"),
    "radius_50": ("m", "radius about the centroid that holds 50 % of the light"),
    "radius_90": ("m", "radius about the centroid that holds 90 % of the light"),
    "shift_rms": ("m", "root-mean-square horizontal shift by scattering"),
    "delay_mean": ("ns", "mean delay by scattering"),
    "delay_std": ("ns", "standard deviation of the delay by scattering"),
    "within_radius": ("1", "share of the light within a radius of the centroid"),
    "within_shift": ("1", "share of the light that scattering has shifted by at most a radius"),
    "within_delay": ("1", "share of the light that scattering has delayed by at most a delay"),
    # signals of targets, and their detection
    "background": ("W", "received power without the target"),
    "difference": ("W", "received power of the target less what it hides"),
    "target.echo": ("J", "energy of the difference in the gate"),
    "backscatter": ("J", "energy of the background in the gate"),
    "shadow": ("J", "negative energy of the difference after the gate"),
    "contrast": ("1", "echo over backscatter"),
    "weight": ("1", "best weight of the pixel in a sum"),
    "detectability": ("J^(1/2)", "echo over the root of the backscatter"),
    "combined_echo": ("J", "energy of the difference in the gate, of pixels together"),
    "combined_contrast": ("1", "echo over backscatter, of pixels together"),
    "combined_detectability": ("J^(1/2)", "echo over the root of the backscatter, of pixels together"),
    "deflection": ("1", "deflection of the full signal"),
    "needed_target": ("1", "share of the target's signal that detection needs"),
    "needed_energy": ("1", "share of the pulse energy that detection needs"),
    "needed_at_depth": ("1", "share of the target's signal that detection needs"),
    "gain_target": ("1", "needed share over that of one detector for all pixels"),
    "gain_energy": ("1", "needed energy over that of one detector for all pixels"),
    "detection": ("1", "probability of detecting the full signal"),
    "pixel_detection": ("1", "probability of detecting the full signal with the pixel alone"),
    "false_alarm": ("1", "probability of false alarm"),
    "expected_detection": ("1", "probability of detection in closed form"),
    "expected_area": ("1", "area below the ROC curve in closed form"),
    "area": ("1", "area below the ROC curve of random shots"),
    "drawn_false_alarm": ("1", "share of random shots without the target that raise an alarm"),
    "drawn_detection": ("1", "share of random shots with the target that are detected"),
    "depth_bias": ("m", "mean error of the depth of the full echo"),
    "depth_spread": ("m", "standard deviation of the depth of the full echo"),
    "depth_gain": ("1", "spread over that of one detector for all pixels"),
    "depth_bound": ("m", "least standard deviation of the depth of the full echo"),
    "detectable_depth": ("m", "depth down to which the target is detected"),
    # highest points of shots
    "surface_peak": ("W", "highest power of the surface echo"),
    "bottom_peak": ("W", "highest power of the bottom echo"),
    "highest.surface_time": ("ns", "time of the highest power of the surface echo"),
    "bottom_time": ("ns", "time of the highest power of the bottom echo"),
    # flights
    "pulse": ("1", "number of the pulse in the flight"),
    **{f"origin_{axis}": ("m", f"position of the scanner, {axis}") for axis in "xyz"},
    **{f"{side}_{axis}": ("1", f"direction {side}, {axis}") for side in ("axis", "far", "left") for axis in "xyz"},
    "scan_angle_deg": ("degree", "angle of the pulse across the flight from the vertical, positive to the right"),
    "line": ("1", "number of the flight line"),
    "group": ("1", "group of pulses of similar poses"),
    "group_angle_deg": ("degree", "angle from nadir of the lidar of the group"),
    "group_height": ("m", "height of the lidar of the group above the mean sea level"),
    "group_x": ("m", "place of the lidar of the group, x"),
    "group_y": ("m", "place of the lidar of the group, y"),
    "record_start_ns": ("ns", "start of the record of the lidar of the group"),
    "sample_start_ns": ("ns", "time of the start of the first sample after the pulse"),
    "time_offset_ns": ("ns", "time of the shot after its group's"),
    "x": ("m", "easting"),
    "y": ("m", "northing"),
    "points.z": ("m", "height above the mean sea level of the scene"),
    "kind": ("1", "class of the point, a code of LAS 1.4"),
    "points.depth": ("m", "depth below the local surface"),
    "intensity": ("", "amplitude of the echo"),
    "x_uncertainty": ("m", "standard deviation of x"),
    "y_uncertainty": ("m", "standard deviation of y"),
    "horizontal_uncertainty": ("m", "root of the sum of the variances of x and y"),
    "vertical_uncertainty": ("m", "standard deviation of z"),
    "depth_uncertainty": ("m", "standard deviation of the depth"),
    "return_number": ("1", "number of the point in its waveform, from 1"),
    "number_of_returns": ("1", "points of the waveform"),
    "gps_time": ("s", "time of the pulse"),
    "quality": ("1", "quality of the point"),
    "withheld": ("1", "whether the echo is saturated or its fit poor"),
    "true_z": ("m", "height of the surface in the beam or of a solid"),
    "true_target": ("1", "whether the highest solid is a target"),
    # campaigns
    "surface_seed": ("1", "parameter surface_seed of the scene"),
    "status": ("1", "state of the run"),
    "campaign.error": ("", "why the run failed"),
    "error_median": ("1", "relative standard error of the median bin"),
    "passes": ("1", "number of passes"),
}

#: Directions of coordinates that count downwards.
_DOWN = ("gate_depth", "depth")


class PointClass(IntEnum):
    """Class of a point, by the codes of LAS 1.4 for bathymetry."""

    BOTTOM = 40
    SURFACE = 41
    OBJECT = 43
    NO_ECHO = 45

    @property
    def text(self) -> str:
        """Name of the class in tables and legends."""
        return {"SURFACE": "water surface"}.get(self.name, self.name.lower().replace("_", " "))


def described(name: str, kind: str = "", unit: str | None = None) -> dict[str, Any]:
    """Return the attributes ``units`` and ``long_name`` of a variable, empty if it is not in the registry.

    Parameters
    ----------
    name
        Name of the variable; with ``_stderr``, ``_low`` or ``_high`` after that of another one, its standard error or
        a limit of its interval.
    kind
        Kind of dataset, whose entry ``kind.name`` goes first.
    unit
        Another unit than that of the registry, as of signals in counts.
    """
    for key in (f"{kind}.{name}", name):
        if key in VARIABLES:
            own, text = VARIABLES[key]
            own = own if unit is None else unit
            down = {"positive": "down"} if name in _DOWN and kind != "points" else {}
            return {**({"units": own} if own else {}), "long_name": text, **down}
    for end, what in (("_stderr", "standard error"), ("_low", "lower limit"), ("_high", "upper limit")):
        if name.endswith(end) and (of := described(name.removesuffix(end), kind, unit)):
            return {**of, "long_name": f"{what} of the {of['long_name']}"}
    return {}


def label(dataset: xr.Dataset, kind: str = "", **units: str) -> xr.Dataset:
    """Return a dataset whose variables without attributes are `described`, with other `units` for some.

    A variable with a standard error names it in ``ancillary_variables``.
    """
    dataset = dataset.copy()
    for name, variable in dataset.variables.items():
        if "long_name" not in variable.attrs and "units" not in variable.attrs:
            base = str(name).removesuffix("_stderr")
            about = described(str(name), kind, units.get(base))
            if about and f"{name}_stderr" in dataset:
                about["ancillary_variables"] = f"{name}_stderr"
            variable.attrs.update({**about, **variable.attrs})
    return dataset


def flagged(meanings: type[IntEnum] | type[IntFlag]) -> dict[str, Any]:
    """Return the attributes of a variable whose values, or bits of a set of flags, are members of an enum."""
    key = "flag_masks" if issubclass(meanings, IntFlag) else "flag_values"
    return {
        key: [int(one) for one in meanings],
        "flag_meanings": " ".join(str(one.name).lower() for one in meanings),
    }
