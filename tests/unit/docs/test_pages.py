"""Pages of the documentation: all are in a table of contents, and their relative links lead to files."""

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
