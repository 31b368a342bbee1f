"""Sphinx configuration. Warnings are errors: `make docs`."""

import sys
from pathlib import Path

import rimlight  # isort: skip (first: it chooses the LLVM library)
import mitsuba

# The API pages import modules whose annotations need a variant
mitsuba.set_variant("llvm_ad_rgb")
sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "Rimlight"
author = "The Rimlight authors"
release = version = rimlight.__version__
html_title = f"Rimlight {version}"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx_inline_tabs",
    "sphinxcontrib.bibtex",
    "accessible",
    "examples",
    "house_docstrings",
    "plugin_pages",
]
myst_enable_extensions = ["amsmath", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Notebooks run when they, or the packages of this environment, have changed: `make clean` forgets their results
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).parent / "_build" / ".jupyter_cache")
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True
bibtex_bibfiles = ["references.bib"]
bibtex_default_style = "plain"
bibtex_reference_style = "author_year"

html_theme = "furo"
html_theme_options = {"sidebar_hide_name": False}
# The demo, as `make docs` has made it
html_extra_path = [str(p) for p in [Path(__file__).parent / "_build" / "extra"] if p.is_dir()]
html_static_path = ["_static"]
html_js_files = ["scrollable.js"]
html_search_scorer = str(Path(__file__).parent / "_static" / "scorer.js")
html_show_sphinx = html_show_copyright = html_copy_source = html_show_sourcelink = False
exclude_patterns = ["_build", "performance/*"]  # tables that index pages include
math_eqref_format = "({number})"
math_numfig = False

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_preserve_defaults = True
