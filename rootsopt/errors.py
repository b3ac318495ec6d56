"""Errors a user can act on."""


class InputError(ValueError):
    """Bad input: the message names the key or file, the value, and what to change.

    The command line prints it and exits with 2.
    """
