"""Configuration of the documentation site: `bash tools/docs` builds it."""

import importlib.util
import os
import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path.insert(0, str(ROOT))

import pydantic  # noqa: E402

import hydrotele  # noqa: E402
from tools.site.repository_pages import find_page  # noqa: E402

project = "hydrotele"
author = "The hydrotele authors"
version = release = hydrotele.__version__
copyright = f"{author}, version {version}"  # the footer

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
smartquotes = False  # options such as --out keep both hyphens
default_role = "code"  # names in docstrings
# Examples of other languages and of output have no language.
highlight_language = "none"

# Markdown
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 4  # links such as gap.md#residual-tests
myst_dmath_double_inline = True
suppress_warnings = [
    "mystnb.unknown_mime_type",  # a notebook may show widgets
    "myst.header",  # pages of experiments start their claims at the third level
]

# Notebooks: `tools/docs --execute` sets the variable; outputs are cached by content of the notebook.
nb_execution_mode = "cache" if os.environ.get("HYDROTELE_DOCS_EXECUTE") else "off"
nb_execution_cache_path = str(DOCS / "_build" / "notebooks")
nb_execution_in_temp = True
nb_execution_timeout = 1800  # s per cell, on a busy computer
nb_execution_raise_on_error = False  # a warning, so that the other notebooks run, too
nb_execution_show_tb = True
nb_merge_streams = True

# References: every one must exist.
nitpicky = True
# Signatures name types of other packages and private classes, which have no pages here.
nitpick_ignore_regex = [(r"py:.*", r".*")]

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
napoleon_use_rtype = False
napoleon_use_ivar = True

# Pages
html_theme = "furo"
html_title = "hydrotele"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
copybutton_exclude = ".linenos, .gp, .go"

# MathJax in one file, so that equations need no network.
_mathjax = importlib.util.find_spec("sphinx-mathjax-offline")
if _mathjax and _mathjax.submodule_search_locations:
    html_static_path.append(str(Path(_mathjax.submodule_search_locations[0], "static", "mathjax", "tex-svg-full.js")))
    mathjax_path = "tex-svg-full.js"

linkcheck_anchors = False

LINK = re.compile(r"\[(?P<text>[^\[\]]*)\]\((?P<up>(?:\.\./)+)(?P<path>[^)#\s]+?)/?(?P<anchor>#[^)\s]*)?\)")
"""A link that leaves the folder of its page upwards."""


def rewrite_links(app, docname: str, source: list[str]) -> None:
    """Point links that leave docs/ to pages of the site; other files become downloads, and folders plain text."""
    folder = Path(app.env.doc2path(docname)).parent

    def rewrite(match: re.Match) -> str:
        file = (folder / match["up"] / match["path"]).resolve()
        if not file.is_relative_to(ROOT) or file.is_relative_to(DOCS):
            return match[0]
        if page := find_page(file):
            return f"[{match['text']}](/{page}{match['anchor'] or ''})"
        return match["text"] if file.is_dir() or file.suffix == ".md" else match[0]

    source[0] = LINK.sub(rewrite, source[0])


def shorten_signature(app, what, name, value, options, signature, returned):
    """Return the signature of a class of a file without its keys, which have their own page."""
    return ("(**keys)", "") if what == "class" and issubclass(value, pydantic.BaseModel) else None


def replace_double_hyphens(app, doctree) -> None:
    """Write a dash between a parameter of a function and its meaning."""
    from docutils import nodes

    if app.env.docname == "reference/python":
        for text in doctree.findall(lambda node: isinstance(node, nodes.Text) and node.astext() == " -- "):
            text.parent.replace(text, nodes.Text(" – "))


def setup(app) -> None:
    """Register the rewriting of links and signatures, and the language of notebooks, which contain shell commands."""
    from ipython_pygments_lexers import IPython3Lexer

    app.add_lexer("python", IPython3Lexer)
    app.connect("source-read", rewrite_links)
    app.connect("doctree-read", replace_double_hyphens)
    app.connect("autodoc-process-signature", shorten_signature)
