"""Names of mutants."""

import hashlib


def key_of(*words: str) -> str:
    """Return a short name for a change, from its text."""
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]
