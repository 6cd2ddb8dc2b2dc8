"""Figure of a comparison: what its legend says."""

from figure_inputs import result
from rows import each_row

from mitransient_lidar.analysis.comparison import compare
from mitransient_lidar.plots.waveforms import plot_comparison


@each_row(([{"integrator": "one", "seed": 1}, {"integrator": "one", "seed": 2}], ["seed 1", "seed 2"]))
def test_legends_name_what_differs(attributes, labels):
    first, second = (result(2, passes=50, **one) for one in attributes)
    figure = plot_comparison(first, second, compare(first, second))
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == labels
