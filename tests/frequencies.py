"""Compare numbers of random samples with expected ones, by chi-squared at the suite's chance of a false alarm."""

import numpy as np
from significance import largest_chi2


def assert_counts(counts, expected, *, known=0):
    """Assert that counts of samples are those expected, within their shot noise.

    Parameters
    ----------
    counts, expected
        Counts of independent samples in cells, and their expectations, of which each is some tens or more.
    known
        Number of sums of the cells that are not random, as 1 where the cells hold all samples.
    """
    statistic, freedom = misfit(counts, expected)
    assert statistic < largest_chi2(freedom - known), (statistic, freedom - known)


def misfit(counts, expected):
    """Return chi-squared of counts and the number of cells."""
    counts, expected = np.broadcast_arrays(np.asarray(counts, dtype=np.float64), expected)
    assert expected.min() > 10
    return float(np.sum((counts - expected) ** 2 / expected)), counts.size


def assert_uniform(values, cells=100):
    """Assert that samples are uniform in [0, 1], as is the cumulative distribution of a variable at its samples."""
    counts = uniform_counts(values, cells)
    assert counts.sum() == np.size(values)
    assert_counts(counts, np.size(values) / cells, known=1)


def uniform_counts(values, cells=100):
    """Return the numbers of samples in equal cells of [0, 1]."""
    return np.histogram(values, bins=cells, range=(0, 1))[0]
