"""An instrument and a receiver of your own
========================================

Laser and optics are parameters of a scene; detector, amplifier and digitiser are a TOML file. Both together are an
instrument, like the `shipped instruments <../guide/instruments.html>`_.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# A small survey lidar at 120 m: a short pulse, a narrow beam and two columns of pixels. ``response_time_ns`` stays 0,
# as the amplifier's bandwidth below is the response.

instrument = {
    "altitude": 120,
    "off_nadir_deg": 15,
    "pulse_energy_mj": 0.1,
    "pulse_fwhm_ns": 1.5,
    "divergence_1e2_mrad": 3,  # full angle at e^-2 of the peak
    "field_of_view_mrad": 9,
    "aperture_area": 0.008,  # m^2
    "layout": "1x2",
    "bin_width_ns": 0.5,
}
water = {"jerlov": "1C", "bottom_depth": 5}

shot = mitransient_lidar.render("table1", params={**instrument, **water}, passes=8, pass_share=1 / 8, seed=1)
print(f"standard error of a bin (median): {100 * shot.error_median:.1f} %")

# %%
# The receiver: a preset, and the differences from it. With ``gain = "auto"`` the amplifier has the largest gain up to 1
# at which nothing saturates.

RECEIVER = """
preset = "apd"
gain = "auto"

[amplifier]
bandwidth_mhz = 250

[digitiser]
bits = 8
full_scale_v = 0.5
low_v = -0.02
sampling_ghz = 1.0
"""

with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "receiver.toml"
    file.write_text(RECEIVER)
    recorded = mitransient_lidar.record(shot, file, shots=20, seed=1)

print(f"gain {float(recorded.gain):.3f}; saturated samples {100 * float(recorded.saturated.mean()):.1f} %")
print(f"best signal-to-noise ratio at the bottom: {float(recorded.snr.sel(time=slice(870, None)).max()):.0f}")

# %%
# Left the power in front of the detector, right one record.

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3), layout="constrained")
for number, colour in enumerate(("tab:blue", "tab:orange")):
    left.semilogy(shot.time, 1e9 * shot.waveform.isel(pixel=number), color=colour, label=f"pixel {number}")
    right.step(recorded.time, 1e3 * recorded.signal.isel(shot=0, pixel=number), color=colour, where="mid", linewidth=1)
left.set(xlabel="time (ns)", ylabel="power (nW)", xlim=(820, 900), ylim=(1, None))
left.legend(frameon=False)
right.set(xlabel="time (ns)", ylabel="signal (mV)", xlim=(820, 900))
plt.show()

# %%
# **What to see.** On the logarithmic axis surface and water column are a slope, and the bottom a peak. In the record
# the bottom is the highest sample, at nine tenths of the digitiser's range: the gain is chosen for it. Eight bits leave
# steps of 2 mV, and less than ten of them for the column just above the bottom.
