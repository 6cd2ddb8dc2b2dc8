"""Score a model's results against the reference in the intercomparison.

``python docs/intercomparison/score.py MY_RESULTS [--reference docs/intercomparison/results/lidar_merging]`` reads
``CASE.csv`` of both folders, prints a table and draws ``MY_RESULTS/score.png``. It needs NumPy and matplotlib.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

HERE = Path(__file__).parent
COLUMNS = ("gate_start_ns", "gate_end_ns", "energy_j", "stderr_j")
#: Largest relative standard error of the reference in a gate that counts.
KNOWN = 0.05
#: Largest difference of a gate in standard errors of two results that agree. By chance one gate of 50 is farther off in
#: 1 of 1000 comparisons with a reference of 32 passes (Student's t), fewer if gates are correlated.
LIMIT = 5.0


@dataclass(frozen=True, eq=False)
class Result:
    """Gate energies and their standard errors [J], and gate edges [ns], shape (gates,)."""

    start: FloatArray
    end: FloatArray
    energy: FloatArray
    stderr: FloatArray


@dataclass(frozen=True)
class Score:
    """Comparison over the gates that count.

    Attributes
    ----------
    gates, all_gates
        Number of gates that count, and all gates' number.
    rms
        A gate's root-mean-square relative difference [1]; both results' random errors are part of it.
    bias
        Relative difference between the sums over these gates [1].
    bias_bound
        Largest standard error of the bias [1]: with fully correlated gate errors.
    chi_squared
        Mean over gates: squared difference divided by the sum of both variances [1]. It is 1 for results that agree,
        also if their gates are correlated, and infinite if a gate without errors differs.
    worst_gate
        Number of the gate with the largest difference in standard errors, from 0.
    worst_z
        That difference [standard errors], with its sign.
    """

    gates: int
    all_gates: int
    rms: float
    bias: float
    bias_bound: float
    chi_squared: float
    worst_gate: int
    worst_z: float

    @property
    def agrees(self) -> bool:
        """Whether no gate differs by more than `LIMIT` standard errors."""
        return abs(self.worst_z) <= LIMIT


def read(path: Path) -> Result:
    """Return the result in a CSV file.

    Raises
    ------
    ValueError
        If columns are missing, or a value is not a finite number or not allowed.
    """
    with path.open() as file:
        names = [name.strip() for name in file.readline().split(",")]
        missing = [name for name in COLUMNS if name not in names]
        if missing:
            raise ValueError(f"{path}: the first line must name the columns {', '.join(COLUMNS)}; no {missing[0]}")
        try:
            table = np.loadtxt(file, delimiter=",", ndmin=2, dtype=np.float64)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    if table.shape[1] != len(names) or not len(table):
        raise ValueError(f"{path}: each of the lines after the first must have {len(names)} numbers")
    result = Result(*(table[:, names.index(name)] for name in COLUMNS))
    if not np.isfinite(table).all() or np.any(result.stderr < 0):
        raise ValueError(f"{path}: values must be finite, and stderr_j at least 0")
    return result


def score(result: Result, reference: Result) -> Score:
    """Return a result's score against the reference for the same case.

    Raises
    ------
    ValueError
        If the gates differ by more than 0.001 of their width, or no reference gate is known.
    """
    width = reference.end - reference.start
    same = result.start.shape == reference.start.shape and all(
        np.all(np.abs(mine - theirs) < 1e-3 * width)
        for mine, theirs in ((result.start, reference.start), (result.end, reference.end))
    )
    if not same:
        raise ValueError("gates must be those of cases.csv")
    counts = (reference.energy > 0) & (reference.stderr <= KNOWN * reference.energy)
    if not counts.any():
        raise ValueError(f"no gate of the reference is known within {100 * KNOWN:g} %")
    number = np.flatnonzero(counts)
    a, b = result.energy[counts], reference.energy[counts]
    errors = result.stderr[counts], reference.stderr[counts]
    error = np.hypot(*errors)
    z = np.divide(a - b, error, out=np.where(a == b, 0.0, np.copysign(np.inf, a - b)), where=error > 0)
    worst = int(np.argmax(np.abs(z)))
    return Score(
        gates=len(number),
        all_gates=len(counts),
        rms=float(np.sqrt(np.mean((a / b - 1) ** 2))),
        bias=float(a.sum() / b.sum() - 1),
        bias_bound=float(np.hypot(*(each.sum() for each in errors)) / b.sum()),
        chi_squared=float(np.mean(z**2)),
        worst_gate=int(number[worst]),
        worst_z=float(z[worst]),
    )


def table(scores: dict[str, Score | None]) -> str:
    """Return a table in Markdown; None is a case without a result."""
    heading = (
        "case",
        "gates",
        "rms difference (%)",
        "bias, largest s.e. (%)",
        "chi-squared per gate",
        "worst gate",
        "agrees",
    )
    lines = [f"| {' | '.join(heading)} |", "|" + "---|" * len(heading)]
    for name, found in scores.items():
        if found is None:
            lines.append(f"| {name} | no result |" + " |" * (len(heading) - 2))
            continue
        columns = (
            name,
            f"{found.gates} of {found.all_gates}",
            f"{100 * found.rms:.2f}",
            f"{100 * found.bias:+.2f}, {100 * found.bias_bound:.2f}",
            f"{found.chi_squared:.3g}",
            f"{found.worst_gate}: {found.worst_z:+.1f} s.e.",
            "yes" if found.agrees else "no",
        )
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def draw(pairs: dict[str, tuple[Result, Result]], path: Path) -> None:
    """Draw energies of results and references, with their ratios below."""
    from mitransient_lidar.plots import drawing, palette

    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    figure = drawing.new_figure(path, 3.2 * columns, 3.6 * rows)
    axes = figure.subplots(2 * rows, columns, squeeze=False, height_ratios=[2, 1] * rows)
    for axis in axes.flat:
        axis.set_visible(False)
    for number, (name, (result, reference)) in enumerate(pairs.items()):
        row, column = divmod(number, columns)
        upper, lower = axes[2 * row, column], axes[2 * row + 1, column]
        time = 0.5 * (reference.start + reference.end) - reference.start[0]
        counts = (reference.energy > 0) & (reference.stderr <= KNOWN * reference.energy)
        upper.plot(time, reference.energy, color="0.6", lw=3, label="reference")
        upper.errorbar(time, result.energy, result.stderr, color=palette.BLUE, fmt=".", ms=3, lw=0.8, label="result")
        upper.set_yscale("log")
        upper.set_ylim(0.5 * reference.energy[counts].min(), 2 * reference.energy[counts].max())
        upper.set_title(name)
        ratio = result.energy[counts] / reference.energy[counts]
        error = reference.stderr[counts] / reference.energy[counts]
        lower.fill_between(time[counts], 1 - 2 * error, 1 + 2 * error, color="0.85")
        lower.errorbar(
            time[counts],
            ratio,
            result.stderr[counts] / reference.energy[counts],
            color=palette.BLUE,
            fmt=".",
            ms=3,
            lw=0.8,
        )
        lower.set_ylim(*np.clip([min(ratio.min(), 0.95) - 0.02, max(ratio.max(), 1.05) + 0.02], 0, 2))
        if number >= len(pairs) - columns:
            lower.set_xlabel("time from the first gate (ns)")
        if column == 0:
            upper.set_ylabel("energy of a gate (J)")
            lower.set_ylabel("ratio (1)")
        for axis in (upper, lower):
            axis.set_visible(True)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    drawing.save(figure, path)


def main() -> None:
    """Score a folder of results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, help="folder with CASE.csv")
    parser.add_argument("--reference", type=Path, default=HERE / "results" / "lidar_merging")
    parser.add_argument("--figure", type=Path, help="default: RESULTS/score.png")
    options = parser.parse_args()
    scores: dict[str, Score | None] = {}
    pairs = {}
    names = [path.stem for path in sorted(options.reference.glob("*.csv"))]
    try:
        if not any((options.results / f"{name}.csv").is_file() for name in names):
            raise ValueError(f"{options.results}: no CASE.csv; the cases are {', '.join(names)}")
        for name in names:
            path = options.results / f"{name}.csv"
            scores[name] = None
            if path.is_file():
                pairs[name] = read(path), read(options.reference / path.name)
                try:
                    scores[name] = score(*pairs[name])
                except ValueError as error:
                    raise ValueError(f"{path}: {error}") from None
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(table(scores))
    draw(pairs, options.figure or options.results / "score.png")


if __name__ == "__main__":
    main()
