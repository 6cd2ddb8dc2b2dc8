"""What figures contain, as numbers and texts: lines, bands, images, axes and labels."""

import numpy as np
from matplotlib.colors import to_hex


def numbers(values):
    """Return count, first, last, least and largest value, and the mean with weights that rise from 1 to 2."""
    values = np.ma.filled(np.ma.asarray(values, dtype=float), np.nan).ravel()
    known = values[np.isfinite(values)]
    if known.size == 0:
        return [values.size, 0]
    weights = 1 + np.linspace(0, 1, values.size)[np.isfinite(values)]
    some = [known[0], known[-1], known.min(), known.max(), np.mean(weights * known)]
    return [values.size, known.size, *(float(f"{value:.6g}") for value in some)]


def colour_of(artist):
    """Return the colour of a line, or of the faces and edges of other artists."""
    if hasattr(artist, "get_color"):
        return to_hex(artist.get_color(), keep_alpha=True)
    colours = [np.reshape(getattr(artist, name)(), (-1, 4))[:1] for name in ("get_facecolor", "get_edgecolor")]
    return [to_hex(one[0], keep_alpha=True) for one in colours if len(one)]


def corners(paths):
    """Return the extent of the vertices of paths."""
    vertices = np.concatenate([np.zeros((0, 2)), *(path.vertices for path in paths)])
    return numbers(vertices[:, 0]) + numbers(vertices[:, 1])


def described_axes(ax):
    """Return what is drawn in axes."""
    legend = ax.get_legend()
    ticks = [text.get_text() for axis in (ax.xaxis, ax.yaxis) for text in axis.get_ticklabels()]
    return {
        "labels": [ax.get_title(), ax.get_xlabel(), ax.get_ylabel()],
        "limits": [ax.get_xscale(), numbers(ax.get_xlim()), ax.get_yscale(), numbers(ax.get_ylim())],
        "legend": [] if legend is None else [text.get_text() for text in legend.get_texts()],
        "texts": [[text.get_text(), *numbers(text.get_position())] for text in ax.texts],
        # Names alone: numbers follow from the limits.
        "ticks": [text for text in ticks if "\\" not in text and any(map(str.isalpha, text))],
        "lines": [
            [colour_of(line), line.get_linestyle(), numbers(line.get_xdata()), numbers(line.get_ydata())]
            for line in ax.lines
        ],
        "patches": [
            [colour_of(patch), *corners([patch.get_path().transformed(patch.get_patch_transform())])]
            for patch in ax.patches
        ],
        "collections": [[colour_of(one), *array_of(one), *corners(one.get_paths())] for one in ax.collections],
        "images": [described_image(image) for image in ax.images],
        "beside": [[child.get_xlabel(), numbers(child.get_xlim())] for child in ax.child_axes],
    }


def array_of(mappable):
    return [] if mappable.get_array() is None else numbers(mappable.get_array())


def described_image(image):
    alpha = [] if image.get_alpha() is None else image.get_alpha()
    colours = [numbers(image.get_clim()), image.get_cmap().name, numbers(alpha)]
    return [numbers(image.get_extent()), image.origin, *colours, *array_of(image)]


def described(figure):
    """Return what is drawn in a figure: its own texts, and what each of its axes holds."""
    if any(ax.child_axes for ax in figure.axes):
        # Axes beside others have no limits before.
        figure.draw_without_rendering()
    texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    titles = [figure.get_suptitle(), figure.get_supxlabel(), figure.get_supylabel()]
    return [titles + texts, *(described_axes(ax) for ax in figure.axes)]


def differences(found, expected, place=""):
    """Return the places at which two descriptions differ; numbers may differ by 1e-4 of them."""
    if isinstance(expected, dict) and isinstance(found, dict) and expected.keys() == found.keys():
        return [one for key in expected for one in differences(found[key], expected[key], f"{place}.{key}")]
    if isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        pairs = zip(found, expected, strict=True)
        return [one for number, pair in enumerate(pairs) for one in differences(*pair, f"{place}[{number}]")]
    if isinstance(expected, float) and isinstance(found, (int, float)):
        return [] if abs(found - expected) <= 1e-4 * abs(expected) + 1e-12 else [f"{place}: {found}, not {expected}"]
    return [] if found == expected else [f"{place}: {found!r}, not {expected!r}"]
