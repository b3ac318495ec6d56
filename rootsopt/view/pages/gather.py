"""Reads the files of a run back into the data that the report shows."""

import csv
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rootsopt.config import Config, load
from rootsopt.response.records import Series
from rootsopt.view.ending import Ending, ending
from rootsopt.view.files import ResultFolder, design_file
from rootsopt.view.tables import NAMES, records_of

# Columns of `response_*.csv`, by field of `Series`.
_COLUMNS = {
    "time": "time_s",
    "rotation": "rotation_deg",
    "relative": "relative_rotation_rad",
    "rate": "relative_speed_rad_s",
    "drive_force": "drive_flank_force_N",
    "coast_force": "coast_flank_force_N",
}


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


@dataclasses.dataclass(frozen=True)
class Run:
    """A run as its files describe it.

    `command`: name of the command; `source`: its arguments as the user gave them; `path`: final
    path of the result folder; `config`: resolved config, with its YAML as `yaml`; `result`: content
    of the result file; `cases`: designs and motions; `rows`: rows of a sweep's table;
    `figures`: content of each PNG file by name; `usable`: whether the run ended with a usable
    result (exit code 0); `imports`: files and modules of `--import`."""

    command: str
    source: str
    path: Path
    config: Config
    yaml: str
    result: Mapping[str, Any]
    cases: tuple[Case, ...]
    rows: tuple[dict[str, Any], ...]
    figures: Mapping[str, bytes]
    usable: bool
    imports: Sequence[str] = ()

    @property
    def end(self) -> Ending:
        """What came out and what to do next, as on the terminal."""
        return ending(self.result, self.path, self.source, self.imports, self.rows)

    @classmethod
    def of(
        cls,
        folder: ResultFolder,
        result: Mapping[str, Any],
        source: str,
        usable: bool,
        imports: Sequence[str] = (),
    ) -> "Run":
        """Read the run whose files lie in `folder`.

        `result`: content of the result file, which may not be written yet; `source`, `usable`,
        `imports`: as in the class. Raises `InputError` if a config in the folder cannot be read."""
        place = folder.place
        config = load(place / "config.yaml")
        pictures = sorted((place / "figures").glob("*.png"))
        return cls(
            command=str(result.get("run", {}).get("command", "")),
            source=source,
            path=folder.path,
            config=config,
            yaml=(place / "config.yaml").read_text("utf-8"),
            result=result,
            cases=tuple(_cases(place, config, result)),
            rows=tuple(_rows(place / "sweep.csv")),
            figures={path.name: path.read_bytes() for path in pictures},
            usable=usable,
            imports=imports,
        )


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


def _rows(file: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table, with numbers as numbers and None for empty cells."""
    if not file.exists():
        return
    with file.open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            yield {key: _read(text) for key, text in row.items()}


def _read(text: str) -> Any:
    """Return the value of a cell: a number, None if it is empty or not finite, or its text."""
    try:
        found = float(text)
    except ValueError:
        return text or None
    if text.isdecimal():
        return int(text)
    return found if math.isfinite(found) else None


def _series(place: Path, name: str) -> Series | None:
    """Return the motion in `response_NAME.csv`, or None if there is no such file."""
    file = place / f"response_{name}.csv"
    if not file.exists():
        return None
    with file.open(encoding="utf-8") as lines:
        heads = lines.readline().strip().split(",")
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
    values = {field: table[:, heads.index(column)] for field, column in _COLUMNS.items()}
    values["rotation"] = np.radians(values["rotation"])
    return Series(**values, depth=np.full(len(table), np.nan))
