"""Functions at the top of the package: signatures, documentation, completion."""

import inspect
import pydoc
from pathlib import Path

import jedi
import numpy as np
import pytest
import xarray as xr

import mitransient_lidar
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.results import save


@pytest.mark.parametrize("name", sorted(set(mitransient_lidar.__all__) - {"__version__"}))
def test_every_function_has_a_signature_and_documentation(name):
    function = getattr(mitransient_lidar, name)
    assert name in dir(mitransient_lidar)
    parameters = inspect.signature(function).parameters.values()
    assert not any(one.kind is one.VAR_KEYWORD for one in parameters if name != "render")
    assert len(inspect.getdoc(function)) > 40
    assert "self" not in inspect.signature(function).parameters


def test_citations_name_the_version():
    root, version = Path(__file__).parents[2], mitransient_lidar.__version__
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text("utf-8")
    cited = (root / "docs" / "cite.md").read_text("utf-8")
    assert f"version {version}." in cited
    assert f"version = {{{version}}}" in cited


def test_unknown_functions_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        _ = mitransient_lidar.rendr


def test_help_lists_the_options_of_a_render():
    text = pydoc.plain(pydoc.render_doc(mitransient_lidar.render))
    for option in ("target_error: 'float | None' = None", "max_time", "components", "Returns", "Longest time"):
        assert option in text


@pytest.mark.slow
def test_a_language_server_completes_options():
    for call, wanted in (("render('table1', targ", "target_error="), ("record(shot, opt", "optical_density=")):
        source = f"import mitransient_lidar\nshot = None\nmitransient_lidar.{call}"
        names = [one.name_with_symbols for one in jedi.Script(source).complete()]
        assert wanted in names


def test_open_reads_signals_of_a_receiver(tmp_path):
    time = xr.DataArray(np.arange(40) + 0.5, dims="time")
    waveform = xr.DataArray(np.full((2, 40), 1e-7), dims=("pixel", "time"), coords={"time": time, "pixel": ["a", "b"]})
    attributes = {"time_start_ns": 0.0, "bin_width_ns": 1.0}
    recorded = detect_waveforms(xr.Dataset({"waveform": waveform}, attrs=attributes), "apd", shots=3)
    save(recorded, tmp_path / "signals.nc")
    found = mitransient_lidar.open(tmp_path / "signals.nc")
    np.testing.assert_allclose(found["signal"], recorded["signal"], rtol=1e-6)
