"""Errors that a user can correct."""


class InputError(ValueError):
    """Raised for invalid input. The message names the key or file, the value, and what to change.

    The command line prints the message and exits with code 2.

    >>> import rootsopt
    >>> try:
    ...     rootsopt.load_config("cic", ["scene.speed_rpm=fast"])
    ... except rootsopt.InputError as error:
    ...     print(str(error)[-49:])
    `scene.speed_rpm` must be a number, but is 'fast'
    """
