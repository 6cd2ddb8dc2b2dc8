"""Render options: type, range and meaning of each, shared by functions and commands."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, declared, positive_option

#: Largest number of passes allowed.
MOST_PASSES = 10**9

#: Memory for histograms, unless another one is requested [GB].
DEFAULT_MAX_MEMORY_GB = 2.0

#: Smallest share of a full pass's paths.
SMALLEST_SHARE = 2**-9

TargetError = Annotated[
    float | None,
    Option(
        "Stop at this relative standard error in 95 % of the bins of lit pixels, surface echo to bottom echo, or in "
        "95 % of the gates or of an image's lit pixels. By default 0.03 within 300 s, with gates 0.1 within 60 s, "
        "for images 0.05 within 120 s",
        *(0, 1),
        above=True,
    ),
]
TargetQuantile = Annotated[
    float | None, Option("Share that must reach the target error, by default 0.95; 0.5 is the median", 0.01, 1)
]
MaxTime = Annotated[
    float | None,
    positive_option("Stop before this many seconds, after at least two passes; by default see target error"),
]
Passes = Annotated[
    int | None, Option("Stop after this many independent passes, by default at the target error", 2, MOST_PASSES)
]
SignedSeed = Annotated[int | None, Option("Random seed, by default 0", -(2**63), 2**63 - 1)]
PassShare = Annotated[float | None, Option("Share of a full pass's paths in each pass", SMALLEST_SHARE, 1)]
MaxMemory = Annotated[
    float | None, positive_option("Memory for histograms [GB], by default 2; with less, only gates are kept")
]
Components = Annotated[bool | None, Option("Also separate the light by surface, water, bottom and targets")]
Derivatives = Annotated[
    list[str] | str | None,
    Option(
        "Also differentiate the waveforms by this parameter, e.g. attenuation, bottom_reflectance or bottom_depth. "
        "Repeatable",
        form="NAME",
    ),
]
Batches = Annotated[
    int | None,
    Option(
        "Also keep this many batch waveforms, from which a fit to the result takes its error correlation",
        *(2, 256),
    ),
]
Smooth = Annotated[
    float | None,
    Option(
        "Smooth gate images by a Gaussian with this standard deviation [pixels]: less noise, and a bias, which "
        "results state. Only gates are kept",
        *(0.2, 20),
    ),
]
#: Ways to compute the light of shots.
LIGHT = ("merging", "maps")
LightOption = Annotated[
    str,
    Option(
        "Computation of the light: merging (the default), or maps of the beam at several depths: several times "
        "faster, within 1 %",
        form="|".join(LIGHT),
    ),
]
Variant = Annotated[str | None, Option("Mitsuba variant, e.g. llvm_ad_mono")]

#: Options that results keep, and the attributes that hold them.
KEPT = {name: name for name in ("passes", "seed", "pass_share", "variant")} | {"max_memory": "max_memory_gb"}


@dataclass(frozen=True)
class RenderOptions:
    """Options of a render, None for those that are not given. The commands show their meanings as help.

    Raises UserError if a number is out of range, or a quantile has no error that it must reach.
    """

    target_error: TargetError = None
    target_quantile: TargetQuantile = None
    max_time: MaxTime = None
    passes: Passes = None
    seed: SignedSeed = None
    pass_share: PassShare = None
    max_memory: MaxMemory = None
    components: Components = None
    derivatives: Derivatives = None
    batches: Batches = None
    smooth: Smooth = None
    variant: Variant = None

    def __post_init__(self) -> None:
        options = declared(RenderOptions)
        for one in fields(self):
            if (value := getattr(self, one.name)) is not None:
                kind, option = options[one.name]
                object.__setattr__(self, one.name, option.check(one.name, value, kind))
        if self.target_quantile is not None and self.target_error is None and (self.passes or self.max_time):
            raise UserError(
                f"target_quantile = {self.target_quantile:g} needs a target_error: the error that it must reach"
            )
        if self.smooth is not None and (self.components or self.derivatives or self.batches):
            raise UserError(
                f"smooth = {self.smooth:g} keeps gates alone: leave out components, derivatives and batches"
            )
