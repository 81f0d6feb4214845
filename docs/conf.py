"""Sphinx's settings: `make docs` builds the pages of this folder."""

import re

import sb3_crpn

project = "sb3-crpn"
author = "The sb3-crpn contributors"
copyright = author
release = version = sb3_crpn.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["conf.py"]
html_theme = "furo"
html_title = f"sb3-crpn {version}"
html_theme_options = {
    "source_repository": "https://github.com/sb3-crpn/sb3-crpn/",
    "source_branch": "main",
    "source_directory": "docs/",
}

myst_enable_extensions = ["amsmath", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Notebooks are committed with their output; the tests execute them
nb_execution_mode = "off"

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings say types where the name does not
napoleon_google_docstring = False
napoleon_use_rtype = False

REPOSITORY = "https://github.com/sb3-crpn/sb3-crpn/blob/main/"


def _link_sources(app: object, page: str, content: list[str]) -> None:
    """Links out of this folder, which a reader of the repository follows, lead to it."""
    content[0] = content[0].replace("](../", f"]({REPOSITORY}")


def _link_pages(app: object, path: str, parent: str, content: list[str]) -> None:
    """Links of CHANGELOG.md and CONTRIBUTING.md, which pages include, lead to pages."""
    content[0] = (
        content[0].replace("](docs/", "](").replace("](CODE_OF_CONDUCT.md)", "](conduct.md)")
    )


def _escape_bars(
    app: object, what: str, name: str, documented: object, options: object, lines: list[str]
) -> None:
    """Docstrings write |x| for absolute values; docutils would read a substitution."""
    lines[:] = [re.sub(r"(``.*?``)|(?<!\\)\|", lambda m: m[1] or r"\|", line) for line in lines]


def setup(app: object) -> None:
    """Connect what rewrites links and docstrings."""
    app.connect("autodoc-process-docstring", _escape_bars)  # type: ignore[attr-defined]
    app.connect("source-read", _link_sources)  # type: ignore[attr-defined]
    app.connect("include-read", _link_pages)  # type: ignore[attr-defined]
