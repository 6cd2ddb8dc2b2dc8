"""Objects that plugins make while a scene loads."""

import mitsuba as mi
import pytest

from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scenes import open_scene

SEABED = {"type": "seabed", "depth": 8.0, "size": 20.0}
WATER = {"type": "ocean_surface", "spectrum": "flat", "interior": {"type": "layered_water", "plume_scattering": 1.0}}


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["hg", "petzold", "fournier_forand"])
def test_no_plugin_calls_the_loader(monkeypatch, phase):
    """A loader within the loader replaces the file resolver that other threads use: 1 in 10 processes then failed."""

    def refuse(*_, **__):
        raise AssertionError("load_dict within the constructor of a plugin")

    load_file = mi.load_file
    monkeypatch.setattr(mi, "load_dict", refuse)
    assert open_scene("table1", {"phase_function": phase, "spectrum": "flat"}).scene.shapes()
    assert load_file(str(catalogue.scene_path("ship_wake")), ship_x="0").shapes()


def test_seabed_and_bubbles_are_made_without_the_loader(monkeypatch):
    """They hold a texture and a phase function of their own."""
    for description in (SEABED, WATER):
        load_dict = mi.load_dict
        with monkeypatch.context() as patch:
            patch.setattr(mi, "load_dict", lambda *_, **__: pytest.fail("a plugin calls the loader"))
            assert load_dict(description).bbox().valid()


def test_all_loading_is_serial(monkeypatch):
    """Mitsuba's own plugins are found in one thread."""
    asked = []
    instantiate = mi.parser.instantiate
    monkeypatch.setattr(
        mi.parser, "instantiate", lambda config, parsed: asked.append(config.parallel) or instantiate(config, parsed)
    )
    open_scene("table1", {"spectrum": "flat"})
    assert asked == [False]
