"""Every plugin of the installed Mitsuba works, is refused by name, or is ignored; the guide has a row for each."""

import mitsuba_plugins
import numpy as np
import pytest
import significance

#: Largest difference between the integrators that is no fault.
TOLERATED = 0.01

#: That of a target in the flank of the beam, which the page states: a sphere in place of the instance differs as much.
IN_FLANK = {"instance": 0.025, "shapegroup": 0.025}


def test_page_has_a_row_for_each_plugin_that_is_installed():
    page = mitsuba_plugins.read_page()
    assert page.keys() == mitsuba_plugins.installed().keys()
    figures = {name: row[2] for name, row in page.items() if row[0] == "works"}
    assert len(figures) > 40
    for name, figure in figures.items():
        ratio, error = map(float, figure.split(" ± "))
        assert abs(ratio - 1) < max(3 * error, IN_FLANK.get(name, TOLERATED)), name


@pytest.mark.slow
def test_plugins_are_refused_and_ignored_as_the_page_states():
    page = mitsuba_plugins.read_page()
    rows = {row.plugin: row for row in mitsuba_plugins.beside()}
    for plugin, (verdict, told, _) in page.items():
        if verdict == "works":
            continue
        row = rows.get(plugin) or mitsuba_plugins.refused(plugin, mitsuba_plugins.installed()[plugin])
        assert (row.verdict, row.told) == (verdict, told)
        assert verdict == "ignored" or told.count(". ") == 0


# Half a minute each: other tests have the common shapes, materials, bitmaps and phase functions.
@pytest.mark.long
@pytest.mark.parametrize("builder", mitsuba_plugins.GROUPS, ids=lambda builder: builder.__name__)
def test_plugins_that_work_return_the_light_of_the_reference(builder, tmp_path):
    page = mitsuba_plugins.read_page()
    found = list(mitsuba_plugins.working(builder(tmp_path), passes=16, share=1 / 8))
    assert [page[row.plugin][:2] for row in found] == [[row.verdict, row.told] for row in found]
    fast, reference = (np.transpose(passes) for passes in zip(*(row.passes for row in found), strict=True))
    significance.assert_same(fast, reference, error=0.03, bias=TOLERATED)
