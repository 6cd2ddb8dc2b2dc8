"""Self-contained HTML page that shows traces of Plotly in three dimensions to scale, without network or installation.

``page.html`` is the page; Plotly's script and the traces are embedded as base64 of raw deflate data.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.plots.gate_viewer.page import POLICY


def page_text(
    title: str, kind: str, traces: Sequence[Mapping[str, Any]], views: Mapping[str, FloatArray], notes: Sequence[str]
) -> str:
    """Return the text of a page.

    Parameters
    ----------
    title, kind
        Name of what the page shows, and what that is.
    traces
        Traces of Plotly with coordinates x, y, z [m].
    views
        Boxes that the page can show by name, lowest and highest corner [m], shape (2, 3); it opens with the first one.
    notes
        Sentences below the drawing.
    """
    import plotly.graph_objects as go
    from plotly.offline import get_plotlyjs

    boxes = {name: box.tolist() for name, box in views.items()}
    filled = {
        "policy": POLICY,
        "title": html.escape(title),
        "kind": html.escape(kind),
        "notes": "".join(f"<p>{html.escape(note)}</p>" for note in notes),
        "views": html.escape(json.dumps(boxes)),
        "figure": _packed(go.Figure(list(traces)).to_json()),
        "library": _packed(get_plotlyjs()),
    }
    text = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    for name, value in filled.items():
        text = text.replace(f"{{{{{name}}}}}", value)
    return text


def _packed(text: str) -> str:
    """Return base64 of the raw deflate data of a text."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return base64.b64encode(packer.compress(text.encode()) + packer.flush()).decode("ascii")
