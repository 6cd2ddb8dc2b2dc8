import numpy as np
import pytest
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.campaigns import plot_campaign

pytestmark = pytest.mark.slow

RUNS, TIME = 60, np.arange(1000, 1050.0)


@pytest.fixture
def campaign():
    """Campaign whose bottoms are found where the attenuation is below 0.5."""
    rng = np.random.default_rng(1)
    attenuation, depth = np.exp(rng.uniform(np.log(0.1), np.log(2), RUNS)), rng.uniform(2, 20, RUNS)
    flags = np.ones((RUNS, 2, 4), dtype=np.int16)
    flags[attenuation < 0.5, :, 3] = 0
    coords = {"attenuation": attenuation, "bottom_depth": depth, "wind_speed": rng.choice([3.0, 6.0, 10.0], RUNS)}
    coords["petzold"] = rng.choice(["clear", "turbid"], RUNS)
    data = {
        "waveform": (("run", "pixel", "time"), rng.random((RUNS, 2, 50)).astype(np.float32)),
        "echo_flags": (("run", "pixel", "echo"), flags),
        "status": ("run", np.where(np.arange(RUNS) == 7, 2, 1)),
        "error_median": ("run", np.full(RUNS, 0.05)),
    }
    attributes = {"title": "Campaign of 60 runs, scene table1", "inputs": {name: name for name in coords}}
    along_run = {name: ("run", column) for name, column in coords.items()}
    labels = {"time": TIME, "echo": ["surface", "column", "target", "bottom"], "run": np.arange(RUNS)}
    return xr.Dataset(data, {**along_run, **labels}, attributes)


def texts(figure):
    return [ax.get_xlabel() for ax in figure.axes] + [ax.get_ylabel() for ax in figure.axes]


def test_sample_distributions_and_responses(campaign, tmp_path):
    figure = plot_campaign(campaign, tmp_path / "campaign.png")
    assert (tmp_path / "campaign.png").stat().st_size > 10_000
    assert figure.get_suptitle() == "Campaign of 60 runs, scene table1: 59 of 60 done, 1 failed"
    assert {"attenuation", "bottom_depth", "wind_speed", "petzold", "share of records with a bottom echo"} <= set(
        texts(figure)
    )
    sample = figure.axes[0]
    assert len(sample.lines) == 12
    assert all(np.nanmax(line.get_ydata()) == 1 for line in sample.lines)
    # The first surface is that over attenuation and depth.
    surface = next(ax for ax in figure.axes if (ax.get_xlabel(), ax.get_ylabel()) == ("attenuation", "bottom_depth"))
    (mesh,) = surface.collections
    mean, edges = np.ma.filled(mesh.get_array(), np.nan), mesh.get_coordinates()[0, :, 0]
    clear, turbid = mean[:, edges[1:] < 0.5], mean[:, edges[:-1] > 0.5]
    assert np.nanmin(clear) == np.nanmax(clear) == 1
    assert np.nanmin(turbid) == np.nanmax(turbid) == 0
    assert surface.get_xscale() == "log"


def test_what_is_below_the_range_is_not_drawn(campaign):
    """Not as a level, at which it would look like a signal."""
    waveform = campaign["waveform"].copy()
    waveform[..., 10:20] = 0
    # The code next to 0 of a converter, before the first light and at the end.
    waveform[..., :5] = waveform[..., 45:] = 1e-4
    waveform[..., 20:45] += 0.1
    ax = plot_campaign(campaign.assign(waveform=waveform)).axes[0]
    for line in ax.lines:
        assert np.isnan(line.get_ydata()[10:20]).all()
        assert np.isfinite(line.get_ydata()[20:45]).all()
        assert np.isnan(line.get_ydata()[[0, 4, 45, 49]]).all()
    assert ax.get_ylim() == (1e-6, 2)


def test_other_contents(campaign):
    figure = plot_campaign(campaign.drop_vars("echo_flags"))
    assert "peak power (log10 W)" in texts(figure)
    figure = plot_campaign(campaign.drop_vars(["echo_flags", "waveform"]))
    assert "relative error of the median bin" in texts(figure)
    assert [text.get_text() for text in figure.axes[0].texts] == ["no records are kept"]
    of_shots = campaign.expand_dims(shot=2, axis=1).assign(
        {name: campaign[name] for name in ("status", "error_median")}
    )
    of_shots = of_shots.assign_coords({name: campaign[name] for name in campaign.attrs["inputs"]})
    assert len(plot_campaign(of_shots).axes[0].lines) == 12


def test_one_parameter_and_few_runs(campaign):
    one = campaign.isel(run=slice(0, 3))
    one.attrs["inputs"] = {"bottom_depth": "bottom_depth"}
    figure = plot_campaign(one)
    assert len(figure.axes[0].lines) == 3
    assert "bottom_depth" in texts(figure)


def test_nothing_to_draw(campaign, tmp_path):
    with pytest.raises(UserError, match="no run that is done"):
        plot_campaign(campaign.assign(status=("run", np.zeros(RUNS, dtype=int))))
    with pytest.raises(UserError, match="must end in"):
        plot_campaign(campaign, tmp_path / "campaign.txt")
