"""Scripts of the gallery have the form that its builder needs; the build of the site executes them."""

import ast
import re
from pathlib import Path

from rows import each_row

GALLERY = Path(__file__).parents[3] / "docs" / "gallery"
SCRIPTS = sorted(GALLERY.glob("*.py"))


def test_header_links_every_script_once():
    text = (GALLERY / "GALLERY_HEADER.rst").read_text(encoding="utf-8")
    linked = re.findall(r"<sphx_glr_auto_gallery_(\w+\.py)>", text)
    assert sorted(linked) == [script.name for script in SCRIPTS]
    assert len(linked) >= 20


@each_row(*zip(SCRIPTS))
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


@each_row(*zip(SCRIPTS))
def test_blocks_of_text_are_comments_up_to_the_code(script):
    """A line of text that lacks its # would run as code, a title without its blank lines would be no heading."""
    for block in re.split(r"^# %%.*\n", script.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        comment = re.match(r"(#.*\n)*", block).group(0)
        rest = block[len(comment) :]
        assert not comment or not rest or rest.startswith("\n")
        assert rest.strip() or comment


@each_row(*zip(SCRIPTS))
def test_files_are_written_into_temporary_folders(script):
    text = script.read_text(encoding="utf-8")
    writes = re.search(r"savefig|write_text|np\.savez?|to_netcdf|\.sweep\(|\.fly\(", text)
    assert not writes or "tempfile.TemporaryDirectory()" in text
