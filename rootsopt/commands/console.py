"""The command `rootsopt COMMAND ...`, and a script that completes its words in a shell."""

import argparse
import difflib
import importlib.util
import sys
from collections.abc import Mapping, Sequence

from rootsopt.commands import cli, door
from rootsopt.commands.table import COMMANDS
from rootsopt.config.explain import tree
from rootsopt.config.reading import Config
from rootsopt.config.sources import shipped
from rootsopt.errors import InputError

_COMPLETION = """

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
    usage = "usage: rootsopt COMMAND CONFIG [options]\n\n" + "\n".join(
        f"  {name:<10} {command.brief}" for name, command in COMMANDS.items()
    )
    usage += "\n\nrootsopt COMMAND --help lists the options and the config keys used most."
    usage += _COMPLETION
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage)
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
    from rootsopt.commands import console
    from rootsopt.errors import InputError

    try:
        print(console.script(arguments[0] if arguments else ""))
    except InputError as error:
        print(f"rootsopt: {error}", file=sys.stderr)
        return door.BAD_INPUT
    return door.OK


def console() -> None:
    """Run `rootsopt` with the arguments of the process, then exit with its exit code."""
    door.leave(main())


SHELLS = "bash", "zsh"
"""Shells for which there is a script."""
_KEYS, _CONFIGS = "_rootsopt_keys", "_rootsopt_configs"

# End of the bash script: no blank after a key, because its value follows.
_NO_SPACE = """
_rootsopt() {
  _shtab_rootsopt "$@"
  [[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace 2>/dev/null
  return 0
}
complete -o bashdefault -F _rootsopt rootsopt"""


def script(shell: str) -> str:
    """Return the completion script for a `shell`.

    Raises `InputError` for an unknown shell, or if shtab is not installed."""
    if shell not in SHELLS:
        raise InputError(f"`--completion` must be {' or '.join(SHELLS)}, but is {shell!r}")
    if importlib.util.find_spec("shtab") is None:
        raise InputError(
            "`--completion` needs shtab; install it with `pip install 'rootsopt[completion]'`"
        )
    import shtab

    whole = argparse.ArgumentParser(prog="rootsopt")
    whole.add_argument("--version", action="store_true", help="print the version")
    tree = whole.add_subparsers()
    for command in COMMANDS.values():
        parent = cli.parser(command)
        _complete(parent, shtab.FILE, shtab.DIRECTORY)
        tree.add_parser(command.name, help=command.purpose, parents=[parent], add_help=False)
    # shtab takes a preamble per shell; its annotation names only text.
    text = shtab.complete(whole, shell, preamble=_preamble())  # type: ignore[arg-type]
    return f"{text}\n{_NO_SPACE}" if shell == "bash" else text


def _complete(parser: argparse.ArgumentParser, file: Mapping, folder: Mapping) -> None:
    """Set how the shell completes the values of the arguments.

    `file`, `folder`: shtab's functions for files and folders, by shell."""
    ways = {
        "config": {"bash": _CONFIGS, "zsh": f"_alternative 'c:config:({' '.join(shipped())})' "
                   "'f:file:_files'"},
        "output": folder,
        "imports": file,
        "overrides": {"bash": _KEYS, "zsh": f"({_keys()})"},
        "over": {"bash": _KEYS, "zsh": f"({_keys()})"},
    }  # fmt: skip
    for action in parser._actions:
        if action.dest in ways:
            action.complete = ways[action.dest]  # type: ignore[attr-defined]


def _keys() -> str:
    return " ".join(f"{key}=" for key in tree(Config))


def _preamble() -> dict[str, str]:
    """Return the functions of the bash script that list keys and configs."""
    return {
        "bash": f"""
{_KEYS}() {{
  compgen -W "{_keys()}" -- "$1"
}}
{_CONFIGS}() {{
  compgen -W "{" ".join(shipped())}" -- "$1"
  compgen -f -- "$1"
}}
"""
    }
