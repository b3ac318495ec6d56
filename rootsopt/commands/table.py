"""The commands: what each does, and its own options.

This module imports little, so that an interrupt is handled even while others are imported."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from rootsopt.commands import door

if TYPE_CHECKING:
    from argparse import ArgumentParser, _ArgumentGroup


class Command(NamedTuple):
    """A command, with the work in the module of its name in `rootsopt.commands.work`.

    `name`; `brief`: what it does, for the list of commands; `purpose`: the same, for its help;
    `options`: adds its own options to a parser; `export`: default of its option `--export`, "" if
    it has none; `writes`: whether it writes a result folder; `reads`: whether it reads a config,
    rather than writing one;
    `takes`: name of its argument in its help, CONFIG or what its work makes a config from;
    `figures`: module of `rootsopt.view.figures` that is loaded while it computes."""

    name: str
    brief: str
    purpose: str
    options: "Callable[[ArgumentParser], None]" = lambda parser: None
    export: str = ""
    writes: bool = True
    reads: bool = True
    takes: str = "CONFIG"
    figures: str = ""

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run the command with the arguments `argv` (`None`: those of the process).

        Return the exit code."""
        return door.through(self.name, lambda: self._run(argv), own=argv is None)

    def begin(self, module: str) -> None:
        """Run the command and end the process, if `module` is "__main__"."""
        if module == "__main__":
            door.leave(self.main())

    def _run(self, argv: Sequence[str] | None) -> int:
        from rootsopt.commands import cli

        return cli.run(self, argv)


def _improve(parser: "ArgumentParser") -> None:
    parser.set_defaults(report=True)
    group = parser.add_argument_group("what is better, and what the file does not say")
    for aim, meaning in (
        ("quieter", "less contact force (default if the flanks touch)"),
        ("tighter", "less leakage (default otherwise)"),
        ("smoother", "less ripple of the flow"),
    ):
        group.add_argument(
            f"--{aim}", dest="aims", action="append_const", const=aim, default=[], help=meaning
        )
    group.add_argument("--config", dest="scene", metavar="FILE",
                       help="YAML file or shipped config with the scene")  # fmt: skip
    for name, kind, meaning in (
        ("lobes", int, "number of lobes"),
        ("unit", str, "unit of the file: mm, cm, m, um, inch"),
        ("centre-distance-mm", float, "distance of the axes"),
        ("length-mm", float, "axial length"),
        ("speed-rpm", float, "speed"),
        ("torque-N-m", float, "load on rotor 2"),
    ):
        group.add_argument(f"--{name}", type=kind, metavar="X", help=meaning)
    _shared(parser)


def _profile(parser: "ArgumentParser") -> None:
    parser.add_argument(
        "--project",
        type=_whole(3, 64),
        metavar="N",
        help="write free_form.yaml: the profile as a free form of N coefficients",
    )
    parser.add_argument(
        "--resembles",
        action="store_true",
        help="find the nearest member of every profile family (takes half a minute)",
    )


def _sweep(parser: "ArgumentParser") -> None:
    group = parser.add_argument_group("points of the sweep")
    group.add_argument(
        "--over",
        action="append",
        default=[],
        metavar="KEY=VALUES",
        help="values of a config key: a list (0.05,0.1), a range (300:6000:39, 1:100:9:log) "
        "or, for samples, an interval (300:6000); repeatable",
    )
    group.add_argument(
        "--zip", action="store_true", help="advance all keys together instead of combining them"
    )
    group.add_argument(
        "--zip-keys",
        action="append",
        default=[],
        metavar="KEY,KEY...",
        help="advance these keys together; repeatable",
    )
    for name, meaning in (
        ("sample", "draw N pseudo-random points"),
        ("sobol", "draw N points of a Sobol sequence, best a power of 2"),
        ("tolerances", "simulate N fresh scenes of `tolerances`, instead of --over"),
        ("seed", "seed of the samples (default: 0)"),
    ):
        group.add_argument(f"--{name}", type=int, metavar="N", help=meaning)
    _shared(parser.add_argument_group("how a sweep runs"))


def _identify(parser: "ArgumentParser") -> None:
    group = parser.add_argument_group("record, and what to fit to it")
    for name, form, meaning in (
        ("data", "FILE", "CSV of samples over rotation_deg or time_s, or of averages; config keys "
         "as columns are operating points, NAME_std standard deviations; repeatable"),
        ("fit", "KEY[=LOW:HIGH]", "config key to fit, and its bounds (default: all that the key "
         "allows); rotation_offset_deg: the reading where a lobe points at rotor 2; repeatable"),
        ("gain", "NAME[,NAME]", "columns that share an unknown gain; repeatable"),
        ("constant", "NAME", "column with an unknown constant added; repeatable"),
        ("profile", "KEY", "fit all others at several values of this key, too; repeatable"),
    ):  # fmt: skip
        group.add_argument(f"--{name}", action="append", default=[], metavar=form, help=meaning)
    group.add_argument("--starts", type=_whole(1, 1000), default=4, metavar="N",
                       help="local fits, from the best of many scenes (default: 4)")  # fmt: skip
    group.add_argument("--seed", type=int, default=0, metavar="N", help="seed of these scenes")


def _whole(low: int, high: int) -> Callable[[str], int]:
    """Return the type of an option: a whole number from `low` to `high`."""

    def read(text: str) -> int:
        import argparse

        if not text.isdecimal() or not low <= int(text) <= high:
            words = f"must be a whole number from {low} to {high}, but is {text}"
            raise argparse.ArgumentTypeError(words)
        return int(text)

    return read


def _shared(parser: "ArgumentParser | _ArgumentGroup") -> None:
    """Add the options of commands whose evaluations may run elsewhere."""
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="start N processes (default: this one, with one thread per core)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="use a running Dask scheduler: tcp://10.0.0.1:8786",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with a run into the same folder that was stopped or killed",
    )


def _explore(parser: "ArgumentParser") -> None:
    parser.add_argument(
        "--port",
        type=_whole(0, 65535),
        default=0,
        metavar="N",
        help="port of the page on 127.0.0.1 (default: any free one)",
    )
    parser.add_argument(
        "--no-browser", action="store_true", help="print the page's address without opening it"
    )


def _new(parser: "ArgumentParser") -> None:
    from rootsopt.config.explain import keys_of
    from rootsopt.config.sheet import Sheet, option

    parser.add_argument("--overwrite", action="store_true", help="replace FILE if it exists")
    group = parser.add_argument_group("catalogue sheet (a terminal asks for what is missing)")
    for key in keys_of(Sheet):
        name, default = option(key.name), f" (default: {key.default})" if key.default else ""
        group.add_argument(
            *dict.fromkeys((name, name.replace("centre", "center"))),
            metavar="NAME" if key.choices else "X",
            # The families stand below.
            help=key.meaning + (f": {key.choices}" if default and key.choices else "") + default,
        )


optimize = Command(
    "optimize",
    "optimise a design and compare it with the baseline",
    "Optimise the design parameters for low contact force and compare with the baseline.",
    _shared,
    export="none",
    figures="runs",
)
improve = Command(
    "improve",
    "find a better rotor than that of a CSV or DXF file",
    "Find what rotor a file holds, and a better one of the same displacement, outer diameter and "
    "clearance.",
    _improve,
    export="dxf",
    takes="ROTOR",
    figures="runs",
)
simulate = Command(
    "simulate",
    "simulate one design in one scene",
    "Simulate one design in one scene: steady state, contact force, its gradient.",
    export="none",
    figures="runs",
)
pareto = Command(
    "pareto",
    "trace the best compromises between two or three terms",
    "Trace the best compromises between two or three terms (pareto.terms).",
    _shared,
    figures="comparisons",
)
sweep = Command(
    "sweep",
    "simulate one design at many speeds, or at values of any keys",
    "Simulate one config at many values of any of its keys (--over), or at many speeds.",
    _sweep,
    figures="sweep",
)
attractors = Command(
    "attractors",
    "find the coexisting motions of one scene",
    "Find the coexisting motions of a scene and the initial states that lead to each.",
    figures="sweep",
)
identify = Command(
    "identify",
    "fit quantities of a scene to a measured record",
    "Find the values of scene and design that fit a measured record best, and how sure they are.",
    _identify,
    figures="force",
)
profile = Command(
    "profile",
    "compute the geometry of one design",
    "Compute the geometry of one design, and export drawings, solids or an animation.",
    _profile,
    # Drawings take less than 1 s, a solid takes 10 s.
    export="dxf,svg",
    figures="runs",
)
explore = Command(
    "explore",
    "move design and scene with sliders on a local page",
    "Serve a local page with a slider per parameter of design and scene (rootsopt[explore]).",
    _explore,
    writes=False,
)
new = Command(
    "new",
    "write a config from a catalogue sheet",
    "Write a commented config from what a catalogue sheet states, with a profile of that size.",
    _new,
    writes=False,
    reads=False,
    takes="FILE",
)
COMMANDS = {
    command.name: command
    for command in (
        optimize,
        improve,
        simulate,
        pareto,
        sweep,
        attractors,
        identify,
        profile,
        explore,
        new,
    )
}
"""All commands by name."""
