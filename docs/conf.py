"""Configuration of the documentation, which `python -m sphinx -W --keep-going docs site` builds."""

import os
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
REPOSITORY = DOCS.parent
sys.path[:0] = [str(DOCS / "_extensions"), str(REPOSITORY)]

# The kernels that run the tutorials import this copy of the library, and take one core each.
os.environ["PYTHONPATH"] = os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL logs every buffer that it allocates

from coachable import __version__  # noqa: E402
from coachable.scene.look import DARK, ICON, LIGHT, Look  # noqa: E402
from coachable.scene.palette import css  # noqa: E402

project = "coachable"
author = "the coachable developers"
copyright = "the coachable developers, Apache-2.0"
release = version = __version__

extensions = [
    "myst_nb",
    "sphinx_design",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "acting_page",
    "api_pages",
    "repository_links",
]
exclude_patterns = ["_extensions", "_static", "images", "jupyter_execute"]
source_suffix = {".rst": "restructuredtext", ".md": "myst-nb"}

# Markdown, as GitHub reads it
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

# Tutorials run when their page is read; an error in one ends the build.
nb_execution_mode = "auto"
nb_execution_timeout = 600
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # what other libraries log while they are imported

# The API, from the docstrings. A single backtick marks a name: a link where it is documented, code otherwise.
default_role = "py:obj"
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100


def _colours(look: Look) -> dict[str, str]:
    return {
        "color-brand-primary": css(look.requested),
        "color-brand-content": css(look.requested),
        "color-foreground-primary": css(look.ink),
    }


html_theme = "furo"
html_theme_options = {"light_css_variables": _colours(LIGHT), "dark_css_variables": _colours(DARK)}
html_title = "coachable"
html_favicon = os.path.relpath(ICON, DOCS)
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
