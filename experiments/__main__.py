"""Run a study, or all of them: `python -m experiments NAME`, `python -m experiments --all`.

Without a name, the studies are listed. Exit code 0: success. 2: bad input, one message on stderr.
3: no result, or the results break a promise that a study checks.
"""

import argparse
import importlib
import os
import pkgutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from experiments._common.driver import NoResultError, Study, conduct
from rootsopt.commands.door import BAD_INPUT, NO_RESULT, OK
from rootsopt.errors import InputError
from rootsopt.runtime import environment

COMMAND = "python -m experiments"

# Folder of the result folders, relative to the repository root.
RESULTS = Path("results/experiments")


def studies() -> dict[str, tuple[str, Study]]:
    """Return text and declaration of every study, by name; the text begins with the question."""
    found = {}
    for module in pkgutil.iter_modules([str(Path(__file__).parent)]):
        if module.ispkg and not module.name.startswith("_"):
            package = importlib.import_module(f"experiments.{module.name}")
            found[module.name] = package.__doc__, package.STUDY
    return found


def parser_of(known: dict[str, tuple[str, Study]]) -> argparse.ArgumentParser:
    """Return a parser with a subcommand for each of the `known` studies."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=f"{__doc__}".split("\n")[0])
    parser.add_argument("--all", action="store_true", help="run all studies")
    _add_common(parser, RESULTS, "small sizes")
    inner = parser.add_subparsers(dest="name", metavar="NAME", prog=COMMAND)
    for name, (text, study) in known.items():
        one = inner.add_parser(
            name, description=text, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        _add_common(one, RESULTS / name, study.quick)
        for option, settings in study.options.items():
            one.add_argument(option, **settings)
    return parser


def _add_common(parser: argparse.ArgumentParser, folder: Path, quick: str) -> None:
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", default=folder,
        help="folder of the results (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help=f"reduced run: {quick}")
    parser.add_argument(
        "--docs", action="store_true", help="also write the published figures into docs/"
    )


def run_all(known: dict[str, tuple[str, Study]], options: argparse.Namespace) -> int:
    """Run all studies, each in a process of its own; print output, time and exit code of each.

    There is one process at a time for every core, except for studies that must run alone."""
    flags = ["--quick"] * options.quick + ["--docs"] * options.docs

    def one(words: tuple[str, ...]) -> tuple[int, str]:
        began, said = time.perf_counter(), " ".join(words)
        print(f"started {said}", file=sys.stderr, flush=True)
        folder = options.output / said.replace(" --", "_").replace(" ", "_")
        command = [sys.executable, "-m", "experiments", *words, "-o", str(folder), *flags]
        done = subprocess.run(
            command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        print(f"\n{said}\n\n{done.stdout}", flush=True)
        return done.returncode, f"{time.perf_counter() - began:8.0f} s  {said}"

    runs = [
        (study.alone is True or study.alone in more, (name, *more))
        for name, (_, study) in known.items()
        for more in ((), *study.further)
    ]
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as processes:
        ends = [*processes.map(one, [words for alone, words in runs if not alone])]
    ends += [one(words) for alone, words in runs if alone]
    for code, text in ends:
        print(f"exit code {code} {text}")
    return NO_RESULT if any(code for code, _ in ends) else OK


def main() -> int:
    """Run what the command line asks for; return the exit code."""
    known = studies()
    parser = parser_of(known)
    options = parser.parse_args()
    if options.quick and options.docs:
        parser.error("--docs publishes figures and cannot be combined with --quick; remove one")
    environment.own_process()
    if options.all:
        return run_all(known, options)
    if options.name is None:
        print("\n".join(f"{name:<14}{text.splitlines()[0]}" for name, (text, _) in known.items()))
        return OK
    try:
        kept = conduct(options.name, known[options.name][1], options)
    except (InputError, NoResultError) as error:
        print(f"{COMMAND} {options.name}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT if isinstance(error, InputError) else NO_RESULT
    return OK if kept else NO_RESULT


if __name__ == "__main__":
    sys.exit(main())
