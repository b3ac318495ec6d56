"""The glossary of the documentation in reports: words that lead to their meaning."""

import functools
import re
from pathlib import Path

from markupsafe import Markup, escape

_PACKAGE = Path(__file__).parents[1]
_PLACES = _PACKAGE / "glossary.md", _PACKAGE.parent / "docs" / "glossary.md"
"""The page of the glossary: in an installed package, and in the source tree."""
_MARGIN = " (margin)"
"""Ending of a common word that is linked only where it is the label of a margin."""


@functools.cache
def glossary() -> dict[str, str]:
    """Return the meaning of each word, in the order of the page."""
    page = next(path for path in _PLACES if path.exists()).read_text("utf-8")
    found = re.findall(r"^(\S.*)\n((?:  .+\n)+)", page.partition("{glossary}\n")[2], re.M)
    return {word: " ".join(meaning.split()) for word, meaning in found}


def anchor(word: str) -> str:
    """Return the identifier of a word's entry in a report."""
    return "word-" + re.sub(r"\W+", "-", word).strip("-").lower()


@functools.cache
def _pattern() -> re.Pattern[str]:
    """Return a pattern of tags, which are skipped, labels of margins (1) and other words (2)."""
    words = sorted(map(re.escape, glossary()), key=len, reverse=True)
    end = re.escape(_MARGIN)
    margins = "|".join(word.removesuffix(end) for word in words if word.endswith(end))
    others = "|".join(word for word in words if not word.endswith(end))
    return re.compile(
        rf"<code>.*?</code>|<[^>]*>|(?<=>)({margins})(?= \(|<)|"
        rf"(?<![\w.-])({others})(?![\w-]|\.\w)",
        re.IGNORECASE | re.DOTALL,
    )


def linked(html: str) -> Markup:
    """Return HTML in which the first mention of each word of the glossary leads to its meaning."""
    words = {word.lower(): word for word in glossary()}
    told = set()

    def link(found: re.Match[str]) -> str:
        key = f"{found[1]}{_MARGIN}".lower() if found[1] else (found[2] or "").lower()
        if key in told or key not in words:
            return found[0]
        told.add(key)
        where, meaning = anchor(key), escape(glossary()[words[key]])
        return f'<a class="term" href="#{where}" title="{meaning}">{found[0]}</a>'

    return Markup(_pattern().sub(link, str(html)))


__all__ = ["anchor", "glossary", "linked"]
