"""Reads the files of a run back into the data and words that the report shows.

The words are the run's task in sentences, and the glossary."""

import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from rootsopt.config.families import family_of
from rootsopt.config.reading import Config, load
from rootsopt.config.units import COLUMNS
from rootsopt.response.result import Series
from rootsopt.view.files import ResultFolder, design_file
from rootsopt.view.names import brief, in_words, listed, name_and_unit, quantity, stated, varied
from rootsopt.view.tables import NAMES, records_of
from rootsopt.view.terminal import ending


@dataclasses.dataclass(frozen=True)
class Case:
    """One design, or one motion of it, that a report shows.

    `name`: name in the report; `config`: config of its family; `design`: parameters in config
    units; `record`: its entry in the result file, empty if it has none; `series`: simulated motion,
    None if there is none. `series.depth` is NaN, because files do not hold it.
    """

    name: str
    config: Config
    design: dict[str, float]
    record: Mapping[str, Any]
    series: Series | None


class Run:
    """A run as the files in `folder` describe it.

    `result`: content of the result file, which may not be written yet; `source`: arguments of the
    command as the user gave them; `usable`: whether the run ended with a usable result (exit code
    0); `imports`: files and modules of `--import`; `rows`: rows of a sweep.

    `command`: name of the command; `path`: final path of the result folder; `config`: resolved
    config, with its YAML as `yaml`; `cases`: designs and motions; `figures`: content of each
    PNG file by name; `end`: outcome and next commands, as on the terminal.

    Raises `InputError` if a config in the folder cannot be read."""

    def __init__(
        self,
        folder: ResultFolder,
        result: Mapping[str, Any],
        source: str,
        usable: bool,
        imports: Sequence[str] = (),
        rows: Sequence[Mapping[str, Any]] = (),
    ):
        place, self.rows = folder.place, rows
        self.result, self.source, self.usable = result, source, usable
        self.command, self.path = str(result["run"]["command"]), folder.path
        self.config = load(place / "config.yaml")
        self.yaml = (place / "config.yaml").read_text("utf-8")
        self.cases = tuple(_cases(place, self.config, result))
        pictures = sorted((place / "figures").glob("*.png"))
        self.figures = {path.name: path.read_bytes() for path in pictures}
        self.end = ending(result, self.path, source, imports, rows)


def _cases(place: Path, config: Config, result: Mapping[str, Any]) -> Iterator[Case]:
    """Yield the designs or motions of a result; at least the config's own design."""
    keys = {name: key for key, name in NAMES.items()}
    own = dict(zip(config.design_keys, map(float, config.design), strict=True))
    for name, record in (records_of(result) or {"design": {}}).items():
        # The nominal member of a measured baseline has the family of the optimum.
        searched = keys.get(name) in ("nominal", "optimized")
        file = design_file(record["point"]) if "point" in record else "optimized.yaml"
        chosen = ("point" in record or searched) and (place / file).exists()
        series = _series(place, keys.get(name, name.removeprefix("motion ")))
        used = load(place / file) if chosen else config
        yield Case(name, used, dict(record.get("design", own)), record, series)


def _series(place: Path, name: str) -> Series | None:
    """Return the motion in `response_NAME.csv`, or None if there is no such file."""
    file = place / f"response_{name}.csv"
    if not file.exists():
        return None
    with file.open(encoding="utf-8") as lines:
        heads = lines.readline().strip().split(",")
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
    columns = dict(zip(heads, table.T, strict=True))
    values = {
        field: columns[name]
        for field, (name, *_) in COLUMNS.items()
        if name in columns and field != "force"  # The sum of the forces on both flanks.
    }
    values["rotation"] = np.radians(values["rotation"])
    return Series(columns["time_s"], **values, depth=np.full(len(table), np.nan))


# Title of the report and task of the run, by command.
_TASKS = {
    "optimize": (
        "Optimisation of {pair}",
        "Find the design with the lowest objective, and compare it with the baseline.",
    ),
    "improve": ("A better rotor: {pair}", "Find a better rotor than that of a file, in its place."),
    "simulate": (
        "Simulation of {pair}",
        "Simulate one design in one scene: steady state, contact force, gradient.",
    ),
    "pareto": (
        "Best compromises for {pair}",
        "Trace the best compromises between two or three quantities.",
    ),
    "sweep": ("Sweep of {pair}", "Simulate one design in many scenes."),
    "attractors": ("Coexisting motions of {pair}", "Find the coexisting motions of a scene."),
    "identify": (
        "What a record tells of {pair}",
        "Fit quantities of a scene to a measured record.",
    ),
    "profile": ("Geometry of {pair}", "Compute the geometry of one design."),
}

_SENSES = {"min": "as low as possible", "max": "as high as possible"}

# Number of design parameters above which sentences do not list them.
_FEW = 6


def title(run: "Run") -> str:
    """Return the title of the report."""
    return _TASKS[run.command][0].format(pair=_pair(run.config))


def asked(run: "Run") -> list[str]:
    """Return sentences on the task of the run."""
    sentences = [_TASKS[run.command][1], scene(run.config)]
    sentences += (run.result.get("improve") or {}).get("found", [])
    if run.command in ("optimize", "improve"):
        sentences.append(_objective(run.config))
        keys = [one.key for one in run.config.scatters]
        if keys:
            shown = listed(keys) if len(keys) <= _FEW else f"{len(keys)} numbers"
            sentences.append(f"The design should be best while these scatter: {shown}.")
    sentences += [f"{note}." for note in run.result.get("notes", ())]
    if run.rows:
        sentences.append(_over(run.rows))
    aims = run.result.get("terms")
    if run.command == "pareto" and aims:
        words = [f"{name_and_unit(aim['name'])[0]} ({_SENSES[aim['sense']]})" for aim in aims]
        sentences.append(f"The quantities are {listed(words)}.")
    return sentences


def _over(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the values that differ between the scenes of a sweep."""
    parts = []
    for key in varied(rows):
        values: list[Any] = [*dict.fromkeys(row.get(key) for row in rows)]
        shown = f"{len(values)} values"
        if len(values) <= _FEW:
            shown = listed([stated(key, x) for x in values])
        elif all(isinstance(x, int | float) for x in values):
            shown += f" from {brief(min(values))} to {stated(key, max(values))}"
        parts.append(f"{name_and_unit(key)[0]}: {shown}")
    return f"Between the scenes, these differ: {'; '.join(parts)}."


def scene(config: Config) -> str:
    """Return one sentence that describes the scene of a config."""
    data = config.scene
    load = data.load
    under = (
        f"under a pressure difference of {quantity(load.pressure_difference_Pa, 'Pa')}"
        if load.torque_N_m is None
        else f"under a load of {brief(load.torque_N_m)} N·m on rotor 2"
    )
    gear, away = data.timing_gear, data.center_distance_error_mm
    parts = (
        gear and f"a timing gear with {brief(gear.backlash_mm)} mm backlash",
        gear and gear.errs and "errors of the gear over a turn",
        data.motor and "a motor whose speed falls under load",
        config.rotor.helix_deg and f"rotors twisted by {quantity(config.rotor.helix_deg, '°')}",
        config.contact.friction and "friction between the flanks",
        data.supports and "elastic bearings",
        config.contact.clearance_mm and f"{brief(config.contact.clearance_mm)} mm clearance",
        away and f"a centre distance error of {brief(away)} mm",
        data.phase_error_mrad and f"a phase error of {brief(data.phase_error_mrad)} mrad",
    )
    present = [str(part) for part in parts if part]
    tail = f", with {listed(present)}" if present else ""
    tail += "" if gear is not None else ", without a timing gear"
    return f"The scene is {_pair(config)}, at {brief(data.speed_rpm)} rpm {under}{tail}."


def _objective(config: Config) -> str:
    weights = config.objective
    shares = {
        "mean force": weights.mean_weight,
        "peak force": weights.peak_weight,
        "RMS force": weights.rms_weight,
    }
    shares |= {f"line {order:g}": x for order, x in weights.line_weights.items()}
    shares |= {name_and_unit(name)[0]: x for name, x in weights.terms.items()}
    total = sum(shares.values()) or 1.0
    words = [f"{100 * x / total:.3g} % {name}" for name, x in shares.items() if x]
    speeds = [*map(brief, weights.speeds_rpm)]
    over = f", over the speeds {listed(speeds)} rpm" if speeds else ""
    return f"The objective is {listed(words)}, each relative to the baseline{over}."


def _pair(config: Config) -> str:
    profile = config.profile
    name = "measured" if profile.from_file else in_words(profile.family)
    if family_of(profile.family).maker is not None and len(name) <= 3:
        name = name.upper()
    radius = brief(profile.pitch_radius_mm)
    article = "an" if name[0] in "aeioAEIO" else "a"
    return f"{article} {name} rotor pair with {profile.lobes} lobes, pitch radius {radius} mm"


_PACKAGE = Path(__file__).parents[2]

# The page of the glossary: in an installed package, and in the source tree.
_PLACES = _PACKAGE / "glossary.md", _PACKAGE.parent / "docs" / "glossary.md"

# Suffix in the glossary of a common word that is linked only as the label of a margin.
_MARGIN = " (margin)"


@functools.cache
def glossary() -> dict[str, str]:
    """Return the meaning of each word, in the order of the page."""
    page = next(path for path in _PLACES if path.exists()).read_text("utf-8")
    entries = re.findall(r"^(\S.*)\n((?:  .+\n)+)", page.partition("{glossary}\n")[2], re.M)
    return {word: " ".join(meaning.split()) for word, meaning in entries}


def anchor(word: str) -> str:
    """Return the identifier of a word's entry in a report."""
    return "word-" + re.sub(r"\W+", "-", word).strip("-").lower()


@functools.cache
def _pattern() -> re.Pattern[str]:
    """Return a pattern of the words to link.

    Group 1 matches labels of margins, group 2 other words. Tags match without a group, to be
    skipped."""
    words = sorted(map(re.escape, glossary()), key=len, reverse=True)
    end = re.escape(_MARGIN)
    margins = "|".join(word.removesuffix(end) for word in words if word.endswith(end))
    others = "|".join(word for word in words if not word.endswith(end))
    return re.compile(
        rf"<code>.*?</code>|<[^>]*>|(?<=>)({margins})(?= \(|<)|"
        rf"(?<![\w.-])({others})(?![\w-]|\.\w)",
        re.IGNORECASE | re.DOTALL,
    )


def linked(html: str) -> Markup:
    """Return HTML in which the first mention of each word of the glossary leads to its meaning."""
    words = {word.lower(): word for word in glossary()}
    told = set()

    def link(match: re.Match[str]) -> str:
        key = f"{match[1]}{_MARGIN}".lower() if match[1] else (match[2] or "").lower()
        if key in told or key not in words:
            return match[0]
        told.add(key)
        where, meaning = anchor(key), escape(glossary()[words[key]])
        return f'<a class="term" href="#{where}" title="{meaning}">{match[0]}</a>'

    return Markup(_pattern().sub(link, str(html)))
