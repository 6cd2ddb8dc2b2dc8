"""TOML files."""

from __future__ import annotations

import sys
from typing import Any

from mitransient_lidar.core.errors import UserError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def parse_toml(text: str, name: object) -> dict[str, Any]:
    """Return the contents of a TOML file; raise `UserError`, with the name of the file, for another text."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise UserError(f"{name} is not a TOML file: {' '.join(str(error).split())}") from error
