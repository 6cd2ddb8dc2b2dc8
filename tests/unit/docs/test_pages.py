"""Pages and gallery: contents, links, pictures, words of the search, and the table of the validation."""

import ast
import csv
import importlib
import re
from pathlib import Path

from rows import each_row

from mitransient_lidar import __version__
from mitransient_lidar.loading.variants import PLUGIN_MODULES

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
#: What the build of the site writes, by the first part of a path below docs.
GENERATED = [line.removeprefix("/docs/") for line in (ROOT / ".gitignore").read_text().splitlines() if "/docs/" in line]
#: Folders of sources that are no pages by themselves.
_SOURCES = ("gallery", "templates", "images")


def is_generated(path: Path) -> bool:
    return path.is_relative_to(DOCS) and path.relative_to(DOCS).as_posix().startswith(tuple(GENERATED))


def pages() -> list[Path]:
    found = [path for suffix in ("md", "rst") for path in DOCS.rglob(f"*.{suffix}")]
    return [page for page in found if page.relative_to(DOCS).parts[0] not in _SOURCES and not is_generated(page)]


def contents(page: Path) -> list[Path]:
    """Return the entries of the tables of contents of a page, as files without a suffix."""
    blocks = re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    return [page.parent / line for line in lines if line and not line.startswith(":")]


def test_every_page_is_in_one_table_of_contents() -> None:
    entries = [entry.resolve() for page in pages() for entry in contents(page)]
    assert len(entries) == len(set(entries))
    listed = {page for page in pages() if page.with_suffix("") in entries}
    assert set(pages()) - listed == {DOCS / "index.md"}


@each_row(*zip(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *zip(pages()))
def test_relative_links_lead_to_files(page: Path) -> None:
    text = re.sub(r"^( *)```.*?^\1```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    targets = re.findall(r"\]\(<?([^)\s#>]+)[^)]*\)", text)
    files = [(page.parent / target).resolve() for target in targets if not re.match(r"\w+:", target)]
    missing = [file for file in files if not (file.is_file() or is_generated(file))]
    assert missing == []


def test_every_plugin_has_a_picture() -> None:
    names = set(PLUGIN_MODULES)
    pictures = {path.stem for path in (DOCS / "images" / "plugins").glob("*.png")}
    assert names == {name.removesuffix("_angles") for name in pictures}


def test_entries_of_the_changelog_are_short_and_sorted() -> None:
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert f"\n## {__version__} (" in text
    assert set(re.findall(r"^### (.*)", text, re.MULTILINE)) <= {"Names", "Added", "Changed", "Fixed", "Removed"}
    entries = re.findall(r"^- (.*(?:\n  .*)*)", text, re.MULTILINE)
    assert len(entries) > 100
    assert [entry for entry in entries if len(entry.split()) > 25] == []


@each_row(
    *(("TPU", "guide/uncertainty"), ("S-44", "guide/uncertainty"), ("GPU", "install"), ("macOS", "install")),
    *(("Windows", "install"), ("tutorial", "gallery/ten_minutes"), ("GeoTIFF", "guide/shore")),
    *(("bathymetry", "glossary"), ("hydrography", "glossary"), ("shore", "glossary")),
)
def test_words_of_a_search_are_headings_or_terms(word: str, page: str) -> None:
    """The site's search ranks these first."""
    (path,) = DOCS.glob(f"{page}.*")
    titles = re.findall(r"^(?:#+ (.*)|\"\"\"(.*)|(\w.*)(?=\n  \w))", path.read_text("utf-8"), re.MULTILINE)
    assert re.search(rf"\b{word}\b", "\n".join(map("".join, titles)), re.IGNORECASE)


def test_pages_of_search_words_have_them_in_the_text() -> None:
    for word in ("bathymetry", "hydrography"):
        assert all(word in (ROOT / page).read_text("utf-8") for page in ("README.md", "docs/index.md")), word


def test_every_picture_is_on_a_page() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "README.md", *pages()))
    assert [path.name for path in (DOCS / "images").glob("*.png") if f"images/{path.name})" not in text] == []


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


GALLERY = Path(__file__).parents[3] / "docs" / "gallery"
SCRIPTS = sorted(GALLERY.glob("*.py"))


def test_header_links_every_script_once():
    text = (GALLERY / "GALLERY_HEADER.rst").read_text(encoding="utf-8")
    linked = re.findall(r"<sphx_glr_auto_gallery_(\w+\.py)>", text)
    assert sorted(linked) == [script.name for script in SCRIPTS]
    assert len(linked) >= 20


@each_row(*SCRIPTS)
def test_script_has_title_introduction_figure_and_conclusion(script):
    text = script.read_text(encoding="utf-8")
    module = ast.parse(text)
    title, line, blank, *introduction = ast.get_docstring(module).splitlines()
    assert set(line) == {"="}
    assert len(line) == len(title)
    assert not blank
    assert " ".join(introduction)
    calls = [ast.unparse(node.func) for node in ast.walk(module) if isinstance(node, ast.Call)]
    assert "plt.subplots" in calls
    assert calls.count("plt.show") == calls.count("plt.subplots")
    assert "print" in calls
    assert re.search(r"^# \*\*What to see\.\*\* ", text, re.MULTILINE)


@each_row(*SCRIPTS)
def test_blocks_of_text_are_comments_up_to_the_code(script):
    """A line of text that lacks its # would run as code, a title without its blank lines would be no heading."""
    for block in re.split(r"^# %%.*\n", script.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        comment = re.match(r"(#.*\n)*", block).group(0)
        rest = block[len(comment) :]
        assert not comment or not rest or rest.startswith("\n")
        assert rest.strip() or comment


@each_row(*SCRIPTS)
def test_files_are_written_into_temporary_folders(script):
    text = script.read_text(encoding="utf-8")
    writes = re.search(r"savefig|write_text|np\.savez?|to_netcdf|\.sweep\(|\.fly\(", text)
    assert not writes or "tempfile.TemporaryDirectory()" in text
