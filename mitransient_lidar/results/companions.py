"""Results of two channels of an instrument in one dataset: variables of the infrared one have names of their own."""

from __future__ import annotations

import json
from collections.abc import Hashable

import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.documents import parse_json
from mitransient_lidar.results.attributes import attribute

#: Attribute with the JSON of the attributes of the infrared channel; group of its data in files; and part of names.
INFRARED = "infrared"

_PREFIX, _SHARED = f"{INFRARED}_", "shot"


def join(green: xr.Dataset, infrared: xr.Dataset) -> xr.Dataset:
    """Return one dataset of both channels.

    Variables and dimensions of the infrared channel have the prefix ``infrared_``, but for ``shot``, which is that of
    both; of two series, the shots that both have remain.
    """
    names: dict[Hashable, str] = {name: f"{_PREFIX}{name}" for name in (*infrared.variables, *infrared.dims)}
    names.pop(_SHARED, None)
    attributes = {str(name): attribute(str(name), value) for name, value in infrared.attrs.items()}
    own = infrared.rename(names)
    if _SHARED in green.dims:
        count = min(green.sizes[_SHARED], own.sizes[_SHARED])
        green, own = (one.isel({_SHARED: slice(count)}) for one in (green, own))
    return green.assign_coords(own.coords).assign(own.data_vars).assign_attrs({INFRARED: json.dumps(attributes)})


def split(dataset: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Return the green and the infrared channel of a dataset, the latter None where it has none."""
    own = [name for name in dataset.variables if str(name).startswith(_PREFIX)]
    green = dataset.drop_vars(own)
    green.attrs = {name: value for name, value in dataset.attrs.items() if name != INFRARED}
    if INFRARED not in dataset.attrs or not own:
        return green, None
    attributes = parse_json(str(dataset.attrs[INFRARED]), f"the attribute {INFRARED}")
    if not isinstance(attributes, dict):
        raise UserError(f"the attribute {INFRARED} must be an object of JSON")
    kept = own + [name for name in (_SHARED,) if name in dataset.coords]
    infrared = dataset[[name for name in kept if name not in dataset.coords]]
    infrared = infrared.assign_coords({name: dataset.coords[name] for name in kept if name in dataset.coords})
    infrared = infrared.drop_vars([name for name in infrared.coords if name not in kept])
    listed = [*infrared.variables, *infrared.dims]
    names = {name: str(name).removeprefix(_PREFIX) for name in listed if str(name).startswith(_PREFIX)}
    infrared = infrared.rename(names)
    infrared.attrs = attributes
    return green, infrared
