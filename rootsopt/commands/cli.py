"""Shared parts of the commands: arguments and their completion, result folder, float64, exit codes.

Exit code 0: success. 2: bad input, one message on stderr. 3: the run ended without a usable result;
the status says why.
"""

import argparse
import contextlib
import functools
import importlib.util
import os
import shlex
import shutil
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from rootsopt.commands import door
from rootsopt.commands.door import BAD_INPUT, NO_RESULT, OK
from rootsopt.commands.table import COMMANDS, Command
from rootsopt.config import sources
from rootsopt.config.explain import GROUPS, describe, outline, tree
from rootsopt.config.families import families
from rootsopt.config.plausible import notes
from rootsopt.config.reading import Config, load
from rootsopt.errors import InputError
from rootsopt.runtime import environment
from rootsopt.view import figures, pages

if TYPE_CHECKING:
    from rich.console import Console

    from rootsopt.view.names import Table
    from rootsopt.view.runs import RunFolder

# Equinox's checks of traced values call back to Python, and a program with callbacks cannot be
# cached between processes. Every integration here returns a status instead. Equinox reads this
# variable once, when it is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")


class Outcome(NamedTuple):
    """The result of a command that writes a folder.

    `usable`: whether the exit code is 0, not 3; `result`: content of the result file, without the
    versions of the libraries; `lines`, `head`: text on the terminal below and above the tables;
    `rows`: rows of a sweep that the result file does not hold; `most`: number of them above which
    their table is truncated; `tables`: tables for the terminal, by default all of the result;
    `config`: the config of the folder, by default that of the command; `notes` on the input that
    those on its config lack."""

    usable: bool
    result: Mapping[str, Any]
    lines: Sequence[str] = ()
    rows: Sequence[dict[str, Any]] = ()
    most: int = 200
    tables: "Sequence[Table | None] | None" = None
    head: Sequence[str] = ()
    config: Config | None = None
    notes: Sequence[str] = ()


class _Help(argparse.Action):
    """The option `--help [GROUP]`: options and the keys used most, or all keys of a group."""

    def __call__(self, parser, namespace, values, option_string=None):
        if values in GROUPS:
            print(describe(Config, str(values)))
        else:
            parser.epilog = _all_keys() if values == "all" else _few_keys()
            parser.print_help()
        parser.exit()


def _all_keys() -> str:
    """Return the text below the options of `--help all`."""
    listed = "\n".join(f" {group}\n{describe(Config, group)}" for group in GROUPS)
    curves = "\n".join(f"  {name:<18} {one.help}" for name, one in families().items())
    return (
        f"profile families (profile.family):\n{curves}\n\n"
        f"config keys (for --set and the file), units in the name:\n{listed}\n\n"
        "words of reports and messages: docs/glossary.md"
    )


def _few_keys() -> str:
    """Return the text below the options of `--help`."""
    names = textwrap.fill(", ".join(families()), 98, initial_indent="  ", subsequent_indent="  ")
    return (
        f"profile families (profile.family):\n{names}\n"
        f"config keys used most (for --set and the file), units in the name:\n{outline(Config)}\n"
        f"all keys with ranges and defaults: --help all, or --help {' | '.join(GROUPS)}"
    )


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Print `message` as one line on stderr and exit with code 2, as with any bad input."""
        self.exit(BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def parser(command: Command) -> argparse.ArgumentParser:
    """Return the parser of a `command`: the arguments that every command takes, then its own."""
    columns = shutil.get_terminal_size((100, 24)).columns
    result = _Parser(
        prog=f"rootsopt {command.name}",
        usage=f"rootsopt {command.name} {command.takes} [options]",
        description=command.purpose,
        # The help of most options takes one line each.
        formatter_class=functools.partial(
            argparse.RawDescriptionHelpFormatter, max_help_position=30, width=min(100, columns)
        ),
        add_help=False,
    )
    result.add_argument(
        "config",
        type=Path,
        metavar=command.takes,
        help={
            "CONFIG": f"YAML file or shipped: {', '.join(sources.shipped())}",
            "ROTOR": "CSV or DXF file with the outline of a rotor",
        }.get(command.takes, "YAML file"),
    )
    result.add_argument(
        "-h",
        "--help",
        action=_Help,
        nargs="?",
        metavar="GROUP",
        help="show this help, or the keys of a group (see below)",
    )
    if command.writes:
        _add_folder(result, command.name)
    result.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="overrides",
        help="override a config key: --set scene.speed_rpm=1500; repeatable",
    )
    _add_import(result)
    result.add_argument(
        "--no-cache",
        action="store_true",
        help="compile again, and keep no compiled programs",
    )
    if command.export:
        figures.add_option(result, command.export)
    command.options(result)
    return result


def _add_folder(result: argparse.ArgumentParser, command: str) -> None:
    """Add the arguments for the result folder of a `command`."""
    result.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        help=f"result folder (default: results/CONFIG-{command})",
    )
    result.add_argument(
        "--overwrite",
        action="store_true",
        help="replace an earlier run there instead of moving it to DIR.1",
    )
    result.add_argument("--no-figures", action="store_true", help="write no figures")
    result.add_argument(
        "--report",
        action="store_true",
        help=f"write {pages.REPORT}, the run on one page (needs rootsopt[pages])",
    )


def _add_import(arguments: argparse.ArgumentParser) -> None:
    arguments.add_argument(
        "--import",
        action="append",
        default=[],
        metavar="FILE",
        dest="imports",
        help="Python file or module to run first, may add families; repeatable",
    )


def _import_extensions(command: str, argv: Sequence[str] | None) -> None:
    """Import the files and modules named by `--import`, before config keys are listed and read.

    `command`, `argv`: as in `run`. Raises `InputError` if an import fails."""
    early = _Parser(prog=f"rootsopt {command}", add_help=False, allow_abbrev=False)
    _add_import(early)
    names = early.parse_known_args(argv)[0].imports
    if names:
        environment.use_float64()
    for name in names:
        sources.import_named(name)


def run(command: Command, argv: Sequence[str] | None) -> int:
    """Run a command and return its exit code.

    `argv`: arguments (`None`: those of the process).

    Parse the arguments, load the config and select double precision. Then call the function `body`
    of the module `rootsopt.commands.work.COMMAND` with a new result folder, write config and result
    into it, move it to its final path and print the result. If the command writes nothing, its
    `body` takes no folder and returns the exit code. If it also reads no config, its `body` takes
    only the options. `InputError` and `OSError` give exit code 2."""
    environment.own_process()
    try:
        _import_extensions(command.name, argv)
        options = parser(command).parse_args(argv)
        options.given = shlex.join(sys.argv[1:] if argv is None else argv)
        for name in options.imports:  # Only the whole parser knows abbreviated options.
            sources.import_named(name)
        if command.writes and options.output is None:
            options.output = os.path.join("results", f"{options.config.stem}-{command.name}")
        own = command.takes == "CONFIG"
        config = load(options.config, options.overrides) if own else None
        for note in notes(config) if config else ():
            environment.say(note)
        environment.use_float64()
        use_cache(wanted=not options.no_cache)
        with environment.explained():
            if not command.reads:
                return _work(command.name)(options)
            if config is None:
                config = _work(command.name, "config_of")(options)
            if not command.writes:
                return _work(command.name)(config, options)
            return _in_folder(command, config, options)
    except InputError as error:
        code, said = BAD_INPUT, " ".join(str(error).split())
    except OSError as error:
        where = f"{error.filename}: " if error.filename is not None else ""
        code, said = BAD_INPUT, f"{where}{sources.reason(error)}"
    except KeyboardInterrupt:
        code, said = NO_RESULT, "stopped by the user"
    print(f"rootsopt {command.name}: {said}", file=sys.stderr)
    return code


def _work(command: str, name: str = "body") -> Callable[..., Any]:
    """Return the function `name` of the module with a command's work."""
    return getattr(importlib.import_module(f"rootsopt.commands.work.{command}"), name)


def _in_folder(command: Command, config: Config, options: argparse.Namespace) -> int:
    """Run a command that writes a folder, with what all of these write; return its exit code."""
    from rootsopt.view.files import write_config
    from rootsopt.view.runs import RESULT, RunFolder

    if options.report:
        pages.require("`--report`")
    with (
        RunFolder(options.output, command.name, options.overwrite) as folder,
        door.leaving(folder.abandon),
    ):
        body = _work(command.name)
        if not options.no_figures:
            # With matplotlib it takes 0.5 s. Meanwhile, programs are loaded or compiled, which does
            # not hold Python's lock.
            module = f"rootsopt.view.figures.{command.figures}"
            threading.Thread(target=importlib.import_module, args=(module,)).start()
        outcome: Outcome = body(config, options, folder)
        write_config(folder, outcome.config or config)
        data = {**outcome.result, "versions": environment.versions()}
        told = [*notes(config), *outcome.notes]
        folder.write_json(RESULT, data | ({"notes": told} if told else {}))
        if options.report:
            _report(folder, options, outcome)
        moved = folder.put_in_place()
        # Write files first: importing the console takes half of the time, and stdout may fail.
        from rich.console import Console

        from rootsopt.view.tables import tables_of
        from rootsopt.view.terminal import ending, show_ending, shown

        out = Console()
        result, rows = folder.result, outcome.rows
        _say(out, outcome.head)
        tables = outcome.tables
        out.print(shown(tables_of(result, rows, outcome.most) if tables is None else tables))
        _say(out, outcome.lines)
        show_ending(out, ending(result, folder.path, options.given, options.imports, rows))
        _say(out, [*moved, f"results in {folder.path}"])
    return OK if outcome.usable else NO_RESULT


def _say(out: "Console", lines: Sequence[str]) -> None:
    for line in lines:
        out.print(line, soft_wrap=True, markup=False, highlight=False)


def _report(folder: "RunFolder", options: argparse.Namespace, outcome: Outcome) -> None:
    """Write the report of a run that has written all its other files.

    If this fails, say so on stderr and go on, so that the result of a long run is not lost."""
    from rootsopt.view.pages.gather import Run
    from rootsopt.view.pages.html import report_text

    try:
        usable, rows = outcome.usable, outcome.rows
        run = Run(folder, folder.result, options.given, usable, options.imports, rows)
        text = report_text(run)
    except Exception as error:
        words = f"{type(error).__name__}: {error}"
        environment.say(f"{pages.REPORT} is not written, because it could not be made: {words}")
    else:
        folder.write_text(pages.REPORT, text)


@contextlib.contextmanager
def waiting(what: str) -> Iterator[Callable[[str], None]]:
    """Show the text `what` during a `with` block, if stderr is a terminal.

    Yield a function that shows another text."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda other: None
        return
    with console.status(what) as shown:
        yield shown.update


def use_cache(wanted: bool = True) -> None:
    """If `wanted`, cache compiled programs between processes in the user's cache folder.

    The environment variable ROOTSOPT_CACHE may name another folder, or turn the cache off. If the
    folder cannot be used, the cache is off. If other users could change the folder's content, the
    cache is off too, and one line on stderr says why."""
    from rootsopt.runtime import programs

    if refused := programs.keep_by_default() if wanted else programs.keep_in(None):
        environment.say(f"compiled programs are not kept between runs: {refused}")


# Shells for which there is a completion script.
_SHELLS = "bash", "zsh"
_KEYS, _CONFIGS = "_rootsopt_keys", "_rootsopt_configs"

# End of the bash script: no blank after a key, because its value follows.
_NO_SPACE = """
_rootsopt() {
  _shtab_rootsopt "$@"
  [[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace 2>/dev/null
  return 0
}
complete -o bashdefault -F _rootsopt rootsopt"""


def completion(shell: str) -> str:
    """Return the script that completes commands, options and config keys in a `shell`.

    Raises `InputError` for an unknown shell, or if shtab is not installed."""
    if shell not in _SHELLS:
        raise InputError(f"`--completion` must be {' or '.join(_SHELLS)}, but is {shell!r}")
    if importlib.util.find_spec("shtab") is None:
        raise InputError(
            "`--completion` needs shtab; install it with `pip install 'rootsopt[completion]'`"
        )
    import shtab

    whole = argparse.ArgumentParser(prog="rootsopt")
    whole.add_argument("--version", action="store_true", help="print the version")
    parts = whole.add_subparsers()
    for command in COMMANDS.values():
        parent = parser(command)
        _complete(parent, shtab.FILE, shtab.DIRECTORY)
        parts.add_parser(command.name, help=command.purpose, parents=[parent], add_help=False)
    functions = f"""
{_KEYS}() {{
  compgen -W "{_keys()}" -- "$1"
}}
{_CONFIGS}() {{
  compgen -W "{" ".join(sources.shipped())}" -- "$1"
  compgen -f -- "$1"
}}
"""
    # shtab takes a preamble per shell; its annotation names only text.
    text = shtab.complete(whole, shell, preamble={"bash": functions})  # type: ignore[arg-type]
    return f"{text}\n{_NO_SPACE}" if shell == "bash" else text


def _complete(parent: argparse.ArgumentParser, file: Mapping, folder: Mapping) -> None:
    """Set how the shell completes the values of the arguments of the parser `parent`.

    `file`, `folder`: shtab's functions for files and folders, by shell."""
    ways = {
        "config": {
            "bash": _CONFIGS,
            "zsh": f"_alternative 'c:config:({' '.join(sources.shipped())})' 'f:file:_files'",
        },
        "output": folder,
        "imports": file,
        "overrides": {"bash": _KEYS, "zsh": f"({_keys()})"},
        "over": {"bash": _KEYS, "zsh": f"({_keys()})"},
    }
    for action in parent._actions:
        if action.dest in ways:
            action.complete = ways[action.dest]  # type: ignore[attr-defined]


def _keys() -> str:
    return " ".join(f"{key}=" for key in tree(Config))
