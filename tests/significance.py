"""The one verdict on random numbers: comparisons whose chance of a false alarm is stated, and counted.

Every comparison of the suite that random numbers decide has the chance `FALSE_ALARM` to fail though nothing is wrong.
The run of all tests counts them and fails when they add up to more than `SUITE_FALSE_ALARM` (see `conftest.py`).
``--seed-shift N`` draws other random numbers everywhere.
"""

import numpy as np
import scipy

#: Chance that any test of the suite fails though nothing is wrong.
SUITE_FALSE_ALARM = 1e-3
#: Chance of each comparison.
FALSE_ALARM = 1e-6

#: Number of comparisons so far, in this process.
comparisons = 0
#: What ``--seed-shift 1`` adds to all seeds: more than the number of passes of any comparison.
SEED_STEP = 1_000_003
#: What is added to all seeds.
seed_shift = 0


def largest_z(passes, values=1):
    """Return the limit of |difference| in standard errors that are taken from the spread of `passes` passes.

    Student's t for as many passes, two-sided, for the largest of `values` (Bonferroni): 7.4 for 16 passes and one
    value, 9.3 for thirteen. For normal errors, as from thousands of samples, pass that number. `passes` may be an array
    with one number for each value.
    """
    _count()
    return scipy.stats.t.isf(0.5 * FALSE_ALARM / values, np.asarray(passes) - 1)


def largest_error(passes, error):
    """Return the limit of a standard error that is taken from the spread of `passes` passes and is truly `error`.

    For normal samples: 2.3 times the error for 8 passes, 1.9 for 16, 1.6 for 32.
    """
    _count()
    return error * float(scipy.stats.chi2.isf(FALSE_ALARM, passes - 1) / (passes - 1)) ** 0.5


def largest_chi2(freedom):
    """Return the limit of a sum of squares of `freedom` standard normal numbers."""
    _count()
    return float(scipy.stats.chi2.isf(FALSE_ALARM, freedom))


def variance_limits(freedom, values=1):
    """Return the limits of the ratio of a variance with this freedom to the true one, for each of some values."""
    _count()
    tail = 0.5 * FALSE_ALARM / values
    return scipy.stats.chi2.isf([1 - tail, tail], freedom) / freedom


def largest_count(trials, chance):
    """Return the limit of the number of `trials` that have a property, each with at most this chance."""
    _count()
    return int(scipy.stats.binom.isf(FALSE_ALARM, trials, chance))


def mean_and_error(samples):
    """Return the mean over the passes (first axis) and its standard error."""
    samples = np.asarray(samples, dtype=np.float64)
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def assert_equal(samples, expected, *, error, bias=0.0):
    """Assert that passes, shape (passes, ...), have the expected mean in every value, and in their sum.

    Parameters
    ----------
    samples
        Independent passes, along the first axis.
    expected
        Expected mean of each value.
    error
        Relative standard error of the sum of the values, which is found within chance (`largest_error`), or less: a
        comparison that is noisier would say little.
    bias
        Relative difference to allow, of the closed form or of the estimator.
    """
    found, own = mean_and_error(_with_sum(samples))
    wanted = _with_sum(np.asarray(expected, dtype=np.float64)[None])[0]
    assert own[-1] < largest_error(len(samples), error) * wanted[-1], own[-1] / wanted[-1]
    _assert_close(found, wanted, own, bias, len(samples))


def assert_same(first, second, *, error, bias=0.0, known=0.1, faint=1e-3, lacking=False, alike=False):
    """Assert that two sets of passes, shapes (passes, ...), have one mean in every value, and in their sum.

    Values with a relative standard error above `known` in either set, or below a share `faint` of the sum, are left
    out: few large contributions make them, which are not normal, and which a set may happen to lack; so are values
    that one set lacks altogether, unless `lacking` is set. With `alike`, values along the second axis, such as those of
    pixels, are known only as well as the least known of them: one that happens to lack large contributions seems to be
    known best, and is too small. `error` and `bias` as in `assert_equal`.
    """
    (a, da), (b, db) = (mean_and_error(_with_sum(samples)) for samples in (first, second))
    if alike:
        da, db = (_largest_along_pixels(mean, own, first.shape[1:]) for mean, own in ((a, da), (b, db)))
    lit = np.hypot(da, db) > 0 if lacking else (da > 0) & (db > 0)
    used = lit & ~(da > known * a) & ~(db > known * b) & (b >= faint * b[-1])
    fewest = min(len(first), len(second))
    assert np.hypot(da, db)[-1] < largest_error(fewest, error) * b[-1], np.hypot(da, db)[-1] / b[-1]
    assert used[:-1].any()
    a, b, da, db = a[used], b[used], da[used], db[used]
    # Welch (1947): passes whose spread would be as uncertain.
    freedom = (da**2 + db**2) ** 2 / (da**4 / (len(first) - 1) + db**4 / (len(second) - 1))
    _assert_close(a, b, np.hypot(da, db), bias, freedom + 1)


def _with_sum(samples):
    """Return the values of each pass in a row, with their sum as a last column."""
    flat = np.asarray(samples, dtype=np.float64).reshape(len(samples), -1)
    return np.concatenate([flat, flat.sum(axis=1, keepdims=True)], axis=1)


def _largest_along_pixels(mean, error, shape):
    """Return errors of values, and of their sum, with the largest relative error along the first axis of `shape`."""
    relative = np.divide(error, mean, out=np.zeros_like(error), where=mean > 0)[:-1].reshape(shape)
    return np.append(relative.max(axis=0, keepdims=True) * mean[:-1].reshape(shape), error[-1])


def _assert_close(found, wanted, error, bias, passes):
    difference = np.maximum(np.abs(found - wanted) - bias * np.abs(wanted), 0)
    z = np.divide(difference, error, out=np.where(difference > 0, np.inf, 0.0), where=error > 0)
    passes = np.broadcast_to(passes, z.shape)
    # Half of the chance for all values, and half for their sum, which is known best.
    limit = np.append(largest_z(passes[:-1], 2 * (z.size - 1)), largest_z(passes[-1], 2))
    worst = int(np.argmax(z / limit))
    assert z[worst] < limit[worst], f"value {worst} of {z.size}: {found[worst]} for {wanted[worst]}, z {z[worst]:.1f}"


def assert_distribution(test):
    """Assert that a ``mitsuba.chi2.ChiSquareTest`` finds no difference, with this suite's chance of a false alarm."""
    _count()
    test.seed += seed_shift
    assert test.run(significance_level=FALSE_ALARM)


def shift_seeds(shift):
    """Shift every seed of NumPy's random numbers in this process, which decide those of passes, too."""
    global seed_shift
    shift *= SEED_STEP
    seed_shift = shift
    if not shift:
        return

    def shifted(seed):
        if isinstance(seed, (int, np.integer)):
            return int(seed) + shift
        return [int(seed[0]) + shift, *seed[1:]] if isinstance(seed, (list, tuple)) else seed

    class ShiftedSequence(np.random.SeedSequence):
        def __init__(self, entropy=None, **options):
            super().__init__(shifted(entropy), **options)

    draw = np.random.default_rng
    np.random.default_rng = lambda seed=None: draw(shifted(seed))
    np.random.SeedSequence = ShiftedSequence


def _count():
    global comparisons
    comparisons += 1
