"""Configuration of the documentation site: ``sphinx-build -W -b html docs site``."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS / "extensions"))
# Figures are drawn to files only.
os.environ["MPLBACKEND"] = "agg"
# The gallery compiles as long as it renders.
os.environ.setdefault("MITRANSIENT_LIDAR_QUICK_KERNELS", "1")

import mitransient_lidar  # noqa: E402  (before mitsuba: it finds LLVM for Dr.Jit)
from mitransient_lidar import _version  # noqa: E402

project = "mitransient-lidar"
author = copyright = "The developers of mitransient-lidar"
version = release = mitransient_lidar.__version__
#: Day of the release, as CITATION.cff states it.
_released = re.search(r"^date-released: (\S+)$", (DOCS.parent / "CITATION.cff").read_text("utf-8"), re.MULTILINE)
myst_substitutions = {
    "version": release,
    "released": _released[1],
    "commit": _version.commit() or "unknown",
    "mitsuba": importlib.metadata.version("mitsuba"),
    "drjit": importlib.metadata.version("drjit"),
}

_mathjax = importlib.util.find_spec("sphinx-mathjax-offline")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinx_design",
    # Pages written from the package when the build starts: docs/extensions/.
    "plugin_pages",
    "command_pages",
    "catalogue_pages",
]
exclude_patterns = ["extensions", "gallery", "templates"]
templates_path = ["templates"]
default_role = "py:obj"

# Markdown.
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath", "substitution"]
myst_heading_anchors = 4

# Python API.
autosummary_generate = True
# The aliases of types, which autodoc takes for classes, have no signature.
autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "Moments, Scattered"}
autodoc_typehints = "none"
numpydoc_show_class_members = False
# Parameters that do not exist, and sections that are unknown or in another order, of the functions that the package
# exports.
numpydoc_validation_checks = {"PR02", "GL06", "GL07"}
numpydoc_validation_exclude = {r"^mitransient_lidar\.\w+\."}

# Literature.
if (DOCS / "references.bib").is_file():
    extensions.append("sphinxcontrib.bibtex")
    bibtex_bibfiles = ["references.bib"]
    bibtex_reference_style = "author_year"

# Gallery: every script runs, two at a time; -D plot_gallery=0 skips them.
if any((DOCS / "gallery").glob("*.py")):
    extensions.append("sphinx_gallery.gen_gallery")
    sphinx_gallery_conf = {
        "examples_dirs": "gallery",
        "gallery_dirs": "auto_gallery",
        "filename_pattern": r"\.py$",
        "ignore_pattern": r"(^|/)_",
        "abort_on_example_error": True,
        "download_all_examples": False,
        "parallel": 2,
        "reset_modules": ("matplotlib", "gallery_style.use_palette"),
        "image_scrapers": ("gallery_style.scrape",),
        "show_memory": False,
        "min_reported_time": 0,
        # The page of times would load scripts from the network.
        "write_computation_times": False,
        "within_subsection_order": "FileNameSortKey",
    }

html_theme = "pydata_sphinx_theme"
html_title = "mitransient-lidar"
# MathJax is part of the site, so that formulas appear without a network. Its package is no extension that is safe for
# parallel builds, but holds the files.
mathjax_path = "mathjax/tex-chtml.js"
html_static_path = ["static", *(f"{folder}/static" for folder in _mathjax.submodule_search_locations)]
html_css_files = ["site.css"]
html_copy_source = False
html_sidebars = {"index": [], "install": []}
html_theme_options = {
    "header_links_before_dropdown": 8,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "navbar_align": "left",
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
