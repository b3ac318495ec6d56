"""`rootsopt --completion SHELL`: a script that completes commands, options and config keys."""

import argparse
import importlib.util
from collections.abc import Mapping

from rootsopt.commands import cli
from rootsopt.commands.table import COMMANDS
from rootsopt.config.explain import tree
from rootsopt.config.reading import Config
from rootsopt.config.sources import shipped
from rootsopt.errors import InputError

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
    functions = f"""
{_KEYS}() {{
  compgen -W "{_keys()}" -- "$1"
}}
{_CONFIGS}() {{
  compgen -W "{" ".join(shipped())}" -- "$1"
  compgen -f -- "$1"
}}
"""
    # shtab takes a preamble per shell; its annotation names only text.
    text = shtab.complete(whole, shell, preamble={"bash": functions})  # type: ignore[arg-type]
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
