"""Errors that a user can correct."""


class InputError(ValueError):
    """Raised for invalid input. The message names the key or file, the value, and what to change.

    The command line prints the message and exits with code 2.
    """
