"""Options of a render: type, range, meaning and attribute of each, shared by functions and commands."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import in_range, integer, positive, relative_error

#: Largest number of passes that can be asked for.
MOST_PASSES = 10**9

#: Smallest share of the paths of a full pass.
SMALLEST_SHARE = 2**-9


def _option(meaning: str, allowed: str = "", low: Any = None, high: Any = None, attribute: str = "") -> Any:
    """Return a field of `RenderOptions`: meaning, range as text and numbers, and the attribute of results that hold it.

    Numbers are greater than 0 where no limits are given.
    """
    about = {"meaning": meaning, "allowed": allowed, "low": low, "high": high, "attribute": attribute}
    return field(default=None, metadata=about)


@dataclass(frozen=True)
class RenderOptions:
    """Options of a render, None for those that are not given. The commands show their meanings as help.

    Raises
    ------
    UserError
        If a number is out of range, or a quantile has no error that it must reach.
    """

    target_error: float | None = _option(
        "Stop when 95 % of the bins of lit pixels, from the surface echo to the end of the bottom echo, have reached "
        "this relative standard error, e.g. 0.03; of gates, 95 % of them; of images, 95 % of the lit pixels",
        "greater than 0, at most 1",
    )
    target_quantile: float | None = _option(
        "Share that must reach the target error instead of 0.95; 0.5 is the median", "0.01 to 1", 0.01, 1
    )
    max_time: float | None = _option("Stop before this many seconds, after at least two passes", "greater than 0")
    passes: int | None = _option("Stop after this many independent passes", "2 to 10^9", 2, MOST_PASSES, "passes")
    seed: int | None = _option(
        "Seed of the random numbers, 0 by default", "-2^63 to 2^63 - 1", -(2**63), 2**63 - 1, "seed"
    )
    pass_share: float | None = _option(
        "Share of the paths of a full pass in each pass", "1/512 to 1", SMALLEST_SHARE, 1, "pass_share"
    )
    max_memory: float | None = _option(
        "Memory for histograms [GB], 2 by default; with less, only gates are kept",
        "greater than 0",
        attribute="max_memory_gb",
    )
    components: bool | None = _option("Also separate the light of surface, water, bottom and targets")
    derivatives: list[str] | None = _option(  # noqa: RUF009 (the default is None)
        "Also differentiate the waveforms by this parameter, e.g. attenuation, bottom_reflectance or bottom_depth. "
        "Repeatable"
    )
    batches: int | None = _option(
        "Also keep the waveforms of this many batches of passes, from which a fit to the result takes the correlation "
        "of its errors",
        "2 to 256",
        2,
        256,
        "batches",
    )
    variant: str | None = _option("Mitsuba variant, e.g. llvm_ad_mono", attribute="variant")

    def __post_init__(self) -> None:
        for one in fields(self):
            value, low, high = getattr(self, one.name), one.metadata["low"], one.metadata["high"]
            if value is None or not one.metadata["allowed"]:
                continue
            if one.name == "target_error":
                number: float = relative_error(one.name, value)
            elif low is None:
                number = positive(one.name, value)
            else:
                number = (integer if isinstance(low, int) else in_range)(one.name, value, low, high)
            object.__setattr__(self, one.name, number)
        if self.target_quantile is not None and self.target_error is None and (self.passes or self.max_time):
            raise UserError(
                f"target_quantile = {self.target_quantile:g} needs a target_error: the error that it must reach"
            )

    @classmethod
    def help(cls, name: str) -> str:
        """Return meaning and range of an option as a sentence."""
        about = cls.__dataclass_fields__[name].metadata
        return f"{about['meaning']} ({about['allowed']})." if about["allowed"] else f"{about['meaning']}."
