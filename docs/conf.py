"""The documentation as a site: Sphinx reads these pages and the docstrings.

    pip install -e ".[docs]" && sphinx-build -W -b html docs docs/_build

Sphinx, because it alone of the common tools takes Markdown (MyST) and Google docstrings alike and
refuses a build with a broken internal link.
"""

project = "dbdnet_jax"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "dbdnet_jax"
html_copy_source = False
html_show_copyright = False

default_role = "literal"  # `name` in a docstring is code
myst_heading_anchors = 2
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 90  # one line for each argument and its shape
napoleon_include_init_with_doc = False
