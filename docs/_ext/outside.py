"""Links of a page to Markdown files outside `docs` lead to the pages that include these files."""

import re

PAGES = {
    "../README.md": "index.md",
    "../CONTRIBUTING.md": "contributing.md",
    "../CHANGELOG.md": "changelog.md",
    "../experiments/README.md": "studies.md",
}
"""Files outside `docs`, as pages link to them, each with its page."""


def _redirected(app, name: str, source: list[str]) -> None:
    for file, page in PAGES.items():
        source[0] = re.sub(rf"\]\({re.escape(file)}", f"]({page}", source[0])


def _included(app, path, parent: str, source: list[str]) -> None:
    """Let links of an included file start at `docs`, as those of the page do."""
    source[0] = re.sub(r"\]\((?:\.\./)?docs/", "](", source[0])
    for file, page in PAGES.items():
        source[0] = re.sub(rf"\]\({re.escape(file.removeprefix('../'))}", f"]({page}", source[0])


def setup(app):
    """Rewrite links when a page, or a file that it includes, is read."""
    app.connect("source-read", _redirected)
    app.connect("include-read", _included)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
