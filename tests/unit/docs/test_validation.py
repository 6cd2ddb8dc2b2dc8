"""The page of the validation has the rows of its table, and these are consistent."""

import csv
import importlib
import re
from pathlib import Path

FOLDER = Path(__file__).parents[3] / "docs" / "validation"
with (FOLDER / "cases.csv").open(newline="") as file:
    ROWS = list(csv.DictReader(file))


def test_the_page_shows_the_table():
    lines = [line for line in (FOLDER / "index.md").read_text().splitlines() if line.startswith("| ")]
    shown = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[1:]]
    assert shown == [[row[name] for name in row if name != "case"] for row in ROWS]


def test_the_script_finds_what_it_takes_from_tests(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "analytic")
    text = (FOLDER / "validate.py").read_text("utf-8")
    modules = re.findall(r"^import (test_\w+) as (\w+)", text, re.MULTILINE)
    assert len(modules) == 3
    for module, alias in modules:
        found = importlib.import_module(module)
        assert [name for name in re.findall(rf"\b{alias}\.(\w+)", text) if not hasattr(found, name)] == []
