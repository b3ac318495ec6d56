"""Names of mutants."""

import hashlib


def key_of(*words: str) -> str:
    """A short name for a change, from what it says."""
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]
