"""Sphinx configuration of the site: `make docs` builds it into build/site."""

import hashlib
import os
import sys
from pathlib import Path

# Notebooks run in a process of their own, with the paths and settings of this one.
ROOT = Path(__file__).parents[1]
for place in (str(ROOT), str(ROOT / "docs" / "_ext")):
    sys.path.insert(0, place)
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
)
os.environ.setdefault("JAX_PLATFORMS", "cpu")

from rootsopt import __version__  # noqa: E402

project = "rootsopt"
author = "the authors of rootsopt"
project_copyright = "the authors of rootsopt, Apache-2.0"
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "keys_and_commands",
    "mathml",
    "outside",
    "signatures",
]
exclude_patterns = ["_ext"]

# Links may lead to headings; one that leads nowhere is an error (`-W`).
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath", "amsmath"]

# Results of notebooks are kept as long as neither they nor the package's code change.
_code = hashlib.sha256()
for _file in sorted((ROOT / "rootsopt").rglob("*.py")):
    _code.update(_file.read_bytes())
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "notebooks" / _code.hexdigest()[:16])
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

# Docstrings use single backticks for code.
default_role = "code"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

# Options begin with two hyphens, which must stay two.
smartquotes = False

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"rootsopt {__version__}"
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
