"""Self-contained HTML page that shows traces of Plotly in three dimensions to scale, without network or installation.

``page.html`` is the page; Plotly's script and the traces are embedded as base64 of raw deflate data.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.plots.gate_viewer.page import POLICY, packed, part


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
        "figure": packed(go.Figure(list(traces)).to_json().encode(), 9),
        "unpack": part("unpack.js"),
        "library": packed(get_plotlyjs().encode(), 9),
    }
    text = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    for name, value in filled.items():
        text = text.replace(f"{{{{{name}}}}}", value)
    return text
