"""A campaign of few paths, its file, and its stores."""

import json
import shutil
from pathlib import Path

#: Runs that take a tenth of a second each.
QUICK = {
    "target_error": 0.3,
    "keep": ["waveform", "truth"],
    "fixed": {"spectrum": "flat", "layout": "1x1", "time_start_ns": 1380, "bin_count": 160},
    "parameters": {"bottom_depth": {"low": 2.0, "high": 9.0}, "bottom_reflectance": "0.02 * bottom_depth"},
    "design": {"kind": "sobol", "count": 12, "seed": 4},
}


def write_toml(path, campaign):
    """Write a campaign as TOML, whose values are those of JSON but for tables."""

    def text(value):
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{key} = {text(one)}" for key, one in value.items()) + " }"
        return json.dumps(value)

    sections = {name: value for name, value in campaign.items() if isinstance(value, dict)}
    lines = [f"{name} = {text(value)}" for name, value in campaign.items() if name not in sections]
    for name, section in sections.items():
        lines += [f"[{name}]", *(f"{key} = {text(value)}" for key, value in section.items())]
    path.write_text("\n".join(lines))
    return path


def files_of(store):
    """Return the contents of the files of a store by name."""
    return {path.relative_to(store): path.read_bytes() for path in Path(store).rglob("*") if path.is_file()}


def planned_copy(store, path):
    """Copy a store, without the status of its runs."""
    shutil.copytree(store, path)
    shutil.rmtree(path / "status" / "c")
    return path
