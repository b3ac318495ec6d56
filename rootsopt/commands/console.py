"""The command `rootsopt COMMAND ...`, which runs the command of this name."""

import difflib
import sys
from collections.abc import Sequence

from rootsopt.commands import door
from rootsopt.commands.table import COMMANDS

_MORE = """\
rootsopt COMMAND --help lists the options and the config keys used most.

The Tab key completes commands, options and config keys after one of
  rootsopt --completion bash > ~/.local/share/bash-completion/completions/rootsopt
  rootsopt --completion zsh > ~/.zfunc/_rootsopt"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = arguments[0] if arguments and arguments[0] in COMMANDS else ""
    return door.through(command, lambda: _called(arguments), own=argv is None)


def _called(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        listed = "\n".join(f"  {name:<10} {one.brief}" for name, one in COMMANDS.items())
        print(f"usage: rootsopt COMMAND CONFIG [options]\n\n{listed}\n\n{_MORE}")
        return door.OK if arguments else door.BAD_INPUT
    name, *rest = arguments
    if name == "--version":
        from rootsopt import __version__

        print(f"rootsopt {__version__}")
        return door.OK
    if name == "--completion":
        return _completed(rest)
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"; did you mean `{near[0]}`?" if near else f"; valid: {', '.join(COMMANDS)}"
        print(f"rootsopt: `{name}` is not a command{hint}", file=sys.stderr)
        return door.BAD_INPUT
    return COMMANDS[name].main(rest)


def _completed(arguments: list[str]) -> int:
    """Print the completion script for the shell that `arguments` name; return the exit code."""
    from rootsopt.commands import cli
    from rootsopt.errors import InputError

    try:
        print(cli.completion(arguments[0] if arguments else ""))
    except InputError as error:
        print(f"rootsopt: {error}", file=sys.stderr)
        return door.BAD_INPUT
    return door.OK


def console() -> None:
    """Run `rootsopt` with the arguments of the process, then exit with its exit code."""
    door.leave(main())
