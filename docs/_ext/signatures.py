"""Signatures name the type `ArrayLike` instead of the long union that stands for it."""

from numpy.typing import ArrayLike
from sphinx.util.typing import stringify_annotation

_LONG = {
    stringify_annotation(ArrayLike, mode) for mode in ("smart", "fully-qualified-except-typing")
}


def _shortened(app, what, name, thing, options, signature, returned):
    for text in sorted(_LONG, key=len, reverse=True):
        signature = signature and signature.replace(text, "ArrayLike")
    return signature, returned


def setup(app):
    """Shorten signatures when autodoc has made them."""
    app.connect("autodoc-process-signature", _shortened)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
