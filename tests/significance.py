"""What chance explains: limits for tests that draw random numbers."""

from scipy.stats import chi2, t

#: Chance that a test fails though nothing is wrong. Another processor rounds otherwise and so draws other paths: every
#: test must stand a new draw, and there are hundreds.
FALSE_ALARM = 1e-5


def largest_z(passes, comparisons=1):
    """Return the limit of |difference| in standard errors that are taken from the spread of `passes` passes.

    Student's t for as many passes, two-sided, for the largest of `comparisons` (Bonferroni): 6 for 16 passes and one
    comparison, 8 for thirteen. For normal errors, as from thousands of samples, pass that number.
    """
    return float(t.isf(0.5 * FALSE_ALARM / comparisons, passes - 1))


def largest_error(passes, error):
    """Return the limit of a standard error that is taken from the spread of `passes` passes and is truly `error`.

    For normal samples: 2.2 times the error for 8 passes, 1.8 for 16, 1.6 for 32.
    """
    return error * float(chi2.isf(FALSE_ALARM, passes - 1) / (passes - 1)) ** 0.5
