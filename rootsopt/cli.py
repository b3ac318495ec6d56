"""What the commands share: arguments, float64, exit codes, console.

Exit 0: success. 2: bad input, one message on stderr. 3: the run ended without a usable
result; the status says why.
"""

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rootsopt import environment
from rootsopt.config import Config, describe_keys, load
from rootsopt.environment import use_compiled_loops as use_compiled_loops
from rootsopt.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

OK, BAD_INPUT, NO_RESULT = 0, 2, 3

# Equinox's checks of traced values call back to Python, and a program that does so cannot
# be kept between processes. Every integration here returns a status instead. Read once,
# when equinox is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")


def parser(command: str, purpose: str) -> argparse.ArgumentParser:
    """The arguments every command takes."""
    result = argparse.ArgumentParser(
        prog=f"rootsopt {command}",
        description=purpose,
        epilog=f"config keys (for --set and the file), units in the name:\n{describe_keys()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("config", type=Path, help="YAML file, for example configs/cic.yaml")
    result.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="result folder (default: results/CONFIG)"
    )
    result.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="overrides",
        help="override a config key, as in --set scene.speed_rpm=1500; repeatable",
    )
    result.add_argument("--no-figures", action="store_true", help="write no figures")
    result.add_argument(
        "--no-cache",
        action="store_true",
        help="compile anew, and keep no compiled programs in the user's cache folder "
        "(ROOTSOPT_CACHE=DIR names another folder, ROOTSOPT_CACHE=off is as this option)",
    )
    return result


def run(
    command: str,
    purpose: str,
    body: Callable[[Config, argparse.Namespace], int],
    argv: Sequence[str] | None,
    add_options: Callable[[argparse.ArgumentParser], None] = lambda _: None,
) -> int:
    """Parse, load, choose float64, run `body`; turn `InputError` into exit 2. `add_options` adds
    the command's own arguments."""
    environment.own_process()
    arguments = parser(command, purpose)
    add_options(arguments)
    options = arguments.parse_args(argv)
    if options.output is None:
        options.output = Path("results") / options.config.stem
    try:
        config = load(options.config, options.overrides)
        use_float64()
        if not options.no_cache:
            use_cache()
        with environment.explained():
            return body(config, options)
    except InputError as error:
        message = " ".join(str(error).split())
        print(f"rootsopt {command}: {message}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"rootsopt {command}: stopped by the user", file=sys.stderr)
        return NO_RESULT
    except BrokenPipeError:
        # The reader of our output has gone (as in `| head`); that is no error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK


@contextlib.contextmanager
def waiting(console: "Console", what: str) -> Iterator[None]:
    """Say `what` goes on, on a terminal; nothing in a pipe."""
    if not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


def use_float64() -> None:
    """Double precision for the whole process, on the CPU or what JAX_PLATFORMS names; chosen here
    and nowhere in the library. Raises `InputError` where the environment does not let JAX start."""
    environment.start_jax()


def use_cache() -> None:
    """Keep compiled programs between processes, in the user's cache folder.

    A folder that cannot be used is no error: the programs are then compiled anew. One line on
    stderr says so where others could change what is kept there.
    """
    import platformdirs

    from rootsopt import programs

    choice = os.environ.get("ROOTSOPT_CACHE", "")
    if choice.lower() not in ("off", "0", "no"):
        folder = choice or platformdirs.user_cache_dir("rootsopt", appauthor=False)
        if refused := programs.keep_in(Path(folder)):
            environment.say(f"compiled programs are not kept between runs: {refused}")


def main(argv: Sequence[str] | None = None) -> int:
    """The console command `rootsopt`: optimize, simulate, sweep, attractors, profile."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands = {
        "optimize": "optimise a design and compare it with the baseline",
        "simulate": "simulate one design in one scene",
        "sweep": "one design at many speeds",
        "attractors": "the motions that coexist in one scene",
        "profile": "geometry of one design",
    }
    usage = "usage: rootsopt COMMAND CONFIG [options]\n\n" + "\n".join(
        f"  {name:<10} {what}" for name, what in commands.items()
    )
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage)
        return OK if arguments else BAD_INPUT
    name, *rest = arguments
    if name == "--version":
        from rootsopt import __version__

        print(f"rootsopt {__version__}")
        return OK
    if name not in commands:
        import difflib

        near = difflib.get_close_matches(name, commands, n=1)
        hint = f"; did you mean `{near[0]}`?" if near else f"; valid: {', '.join(commands)}"
        print(f"rootsopt: `{name}` is not a command{hint}", file=sys.stderr)
        return BAD_INPUT
    import importlib

    return importlib.import_module(f"rootsopt.{name}").main(rest)
