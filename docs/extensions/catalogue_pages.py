"""Reference for the shipped scenes and instruments, from their XML files."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

from generated import remove_others, table, write
from sphinx.application import Sphinx

from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.document import read_document

_SCENES = """\
# Scenes

Shipped scenes, by name: `mitransient-lidar render NAME`, or `mitransient_lidar.render("NAME")`. Every parameter of
a scene and of its plugins is set by `-D name=value` for one run; the pages list those of the scene.
`scenes copy NAME` writes a scene as one file to edit.
"""

_INSTRUMENTS = """\
# Instruments

Transmitters and receivers of real lidars: `mitransient-lidar render SCENE --instrument NAME`. Each value has its
source; those that are not published are assumed, and say so. [The guide](../../guide/instruments.md) shows their use.
"""


def setup(sphinx: Sphinx) -> dict[str, bool]:
    """Write the pages when the build starts."""
    sphinx.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _write(sphinx: Sphinx) -> None:
    reference = Path(sphinx.srcdir) / "reference"
    scenes = {name: _scene(name) for name in catalogue.scene_names()}
    summaries = {name: catalogue.scene_summary(name) for name in scenes}
    _write_pages(reference / "scenes", _SCENES, scenes, summaries)
    known = {name: catalogue.read_instrument(name) for name in catalogue.instrument_names()}
    titles = {name: instrument.title for name, instrument in known.items()}
    _write_pages(reference / "instruments", _INSTRUMENTS, {n: _instrument(one) for n, one in known.items()}, titles)


def _write_pages(folder: Path, introduction: str, pages: dict[str, str], summaries: dict[str, str]) -> None:
    """Write an index with summaries, and a page for each name."""
    listed = table(("name", ""), ((f"[`{name}`]({name}.md)", _plain(summaries[name])) for name in pages))
    contents = "\n".join(["```{toctree}", ":hidden:", "", *pages, "```"])
    write(folder / "index.md", f"{introduction}\n{listed}\n{contents}\n")
    for name, text in pages.items():
        write(folder / f"{name}.md", text)
    remove_others(folder, ["index.md", *(f"{name}.md" for name in pages)])


def _scene(name: str) -> str:
    """Return a scene's page: its comments, parameters with the comments on their lines, and XML."""
    text = catalogue.scene_text(name)
    comments = [textwrap.dedent(one).strip("\n") for one in re.findall(r"<!--(.*?)-->", text, re.DOTALL)]
    about = comments[1] if "\n" in comments[1] else ""
    remarks = dict(re.findall(r'<default name="(\w+)"[^>]*/>[ \t]*<!--(.*?)-->', text))
    rows = [
        (f"`{parameter}`", f"`{value}`" if value else "", _plain(remarks.get(parameter, "").strip()))
        for parameter, value in read_document(catalogue.scene_path(name)).parameters.items()
    ]
    return "\n".join(
        [
            f"# {name}\n\n{_plain(catalogue.scene_summary(name))}.\n",
            f"{_plain(about)}\n",
            f"## Parameters\n\n{table(('name', 'default', ''), rows, 'parameters')}",
            f"## XML\n\nAs `mitransient-lidar scenes show {name}` prints it:\n\n```xml\n{text}```\n",
        ]
    )


def _instrument(one: catalogue.Instrument) -> str:
    """Return an instrument's page: sources, parameters and its receiver file."""
    rows = [(f"`{parameter.name}`", f"`{parameter.value}`", _plain(parameter.source)) for parameter in one.parameters]
    return "\n".join(
        [
            f"# {one.name}\n\n{_plain(one.title)}.\n\nChannels: {', '.join(one.channels)}.\n",
            f"{_list_of_sources(one.description)}\n",
            f"## Parameters\n\n{table(('name', 'value', ''), [row for row in rows if row[1] != '``'], 'parameters')}",
            f"## Receiver\n\nTaken by `record`:\n\n```toml\n{catalogue.receiver_text(one.name)}```\n",
            f"## XML\n\n```xml\n{catalogue.instrument_text(one.name)}```\n",
        ]
    )


def _list_of_sources(description: str) -> str:
    """Return a description with a paragraph for each numbered source."""
    return _plain(re.sub(r"\n(?=\[\d+\])", "\n\n", description))


def _plain(text: str) -> str:
    """Return text in which Markdown sees no markup but links for DOIs."""
    escaped = re.sub(r"([*_<$\[\]])", r"\\\1", text)
    return re.sub(r"doi:(10\.\S*[^\s.,;)])", r"[doi:\1](https://doi.org/\1)", escaped)
