"""Writing of pages that are generated from the package."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path


def write(path: Path, text: str) -> None:
    """Write a page, unless it has this text already: Sphinx reads files again that are newer than its own."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def remove_others(folder: Path, names: Iterable[str]) -> None:
    """Remove pages of former builds, so that a plugin or scene that is gone leaves none."""
    kept = set(names)
    for path in folder.glob("*"):
        if path.is_file() and path.name not in kept:
            path.unlink()


def table(heading: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Return a Markdown table; `kind` is its class for the style sheet."""
    lines = [heading, ["---"] * len(heading), *rows]
    text = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines)
    return f"```{{rst-class}} {kind}\n```\n\n{text}\n" if kind else f"{text}\n"
