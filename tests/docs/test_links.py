"""Every link of the README, of the pages and of the studies leads to a file and a heading."""

import re

import pytest

from tests.docs.blocks import DOCS, ROOT

PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    ROOT / "experiments" / "README.md",
    *sorted(DOCS.rglob("*.md")),
]
FENCE = re.compile(r"^(```|~~~).*?^\1$", re.M | re.S)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
INCLUDE = re.compile(r"^```\{include\} (\S+)$", re.M)


def _anchors(page):
    """Anchors of the headings of a page, as GitHub and MyST make them."""
    text = page.read_text()
    for file in INCLUDE.findall(text):
        text += (page.parent / file).read_text()
    heads = re.findall(r"^#+ +(.+?)\s*$", FENCE.sub("", text), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", link):  # Another site.
            continue
        name, _, anchor = link.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{link} leads nowhere"
        assert file.is_relative_to(ROOT), f"{link} leads out of the project"
        if anchor:
            assert anchor in _anchors(file), f"{link}: {name or page.name} has no such heading"


def test_every_figure_is_in_the_gallery_with_command_and_version():
    text = (DOCS / "gallery.md").read_text()
    entries = re.findall(
        r"^!\[.+\]\((\S+)\)\n\n\*.+\*, version \d+\.\d+\.\d+, \[.+\]\(.+\):\n`(.+)`$", text, re.M
    )
    figures = {file.name for kind in ("*.png", "*.gif") for file in DOCS.rglob(kind)}
    assert {name for name, _ in entries} == figures
    for _, command in entries:
        assert command.startswith(("rootsopt ", "python -m experiments "))
        if command.startswith("python"):
            assert (ROOT / "experiments" / command.split()[3] / "study.py").is_file(), command
