"""Results of baseline and optimum over the spread of what is assumed about the scene."""

import dataclasses
import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.tolerances import Span
from rootsopt.response.scatter import RANDOM

BASELINE, OPTIMIZED, RIVAL = "baseline", "optimized", "design"
"""Names of the compared designs; that of another one ends with its number."""
WINS = 1e-3
"""Difference of two objectives below which neither design counts as better."""

# Levels of the quantiles that are reported, by name.
_LEVELS = {"quantile_5": 0.05, "median": 0.5, "quantile_95": 0.95}
Scenes = Mapping[str, Mapping[str, float]]
"""Values by config key of each scene, by the scene's name; other values are those of the config."""
Piece = tuple[float, float]
"""Part (from, to) of the range of a quantity."""


@dataclasses.dataclass(frozen=True)
class Assumed:
    """Designs in the n scenes of `assumptions`.

    `spans`: ranges of the quantities; `scenes`: see `assumed`; `designs`: designs in config units
    by name: `baseline`, `optimized`, and others that are better than the latter in some scene;
    `objectives`: arrays (n,) by name, relative to the baseline in the same scene, NaN without a
    usable motion of both; `statuses`: labels (n,) by name; `worse`: parts of each range, by key, in
    which the optimised design is worse than the baseline, all else as given; `wins`: the same by
    name of another design, where this is better than the optimised one."""

    spans: tuple[Span, ...]
    scenes: Scenes
    designs: dict[str, dict[str, float]]
    objectives: dict[str, NDArray[np.float64]]
    statuses: dict[str, list[str]]
    worse: dict[str, list[Piece]]
    wins: dict[str, dict[str, list[Piece]]]

    def sample(self, regret: bool) -> tuple[Scenes, tuple[float, ...]]:
        """Return the random scenes over which a search optimises, and what it adds there.

        They are those with a usable motion of all designs. `regret`: whether the least objective of
        all designs is subtracted in each scene; the greatest sum is 1 for the baseline."""
        every = np.array([*self.objectives.values()])
        kept = self.drawn & np.isfinite(every).all(axis=0)
        least = np.min(every[:, kept], axis=0, initial=1.0)
        offsets = np.min(least, initial=1.0) - least if regret else np.zeros(len(least))
        scenes = dict(itertools.compress(self.scenes.items(), kept))
        return scenes, tuple(offsets.tolist())

    @property
    def drawn(self) -> NDArray[np.bool_]:
        """Mask (n,) of the random scenes."""
        return np.array([name.startswith(RANDOM) for name in self.scenes])

    def columns(self) -> dict[str, list[Any]]:
        """Return one row per scene for a table file: its values, objectives and statuses."""
        found: dict[str, list[Any]] = {"scene": [*self.scenes]}
        for key, *_ in self.spans:
            found[key] = [one.get(key, math.nan) for one in self.scenes.values()]
        for name, values in self.objectives.items():
            found[f"objective_{name.replace(' ', '_')}"] = values.tolist()
            found[f"status_{name.replace(' ', '_')}"] = self.statuses[name]
        return found

    def record(self) -> dict[str, Any]:
        """Return the entry `assumptions` of the result file.

        Shares, quantiles and rank correlations are those of the random scenes."""
        values, drawn, names = self.objectives[OPTIMIZED], self.drawn, [*self.scenes]
        known = np.isfinite(values)
        some, ends = values[drawn & known], [x for x in values[~drawn][1:] if math.isfinite(x)]
        worst = int(np.nanargmax(values)) if known.any() else None
        rows = []
        for k, span in enumerate(self.spans):
            low, high = self._ends(values, k)
            rows.append({
                **span._asdict(), "objective_low": low, "objective_high": high,
                "worse": self.worse[span.key], "rank_correlation": self._rank(values, span.key),
            })  # fmt: skip
        return {
            "scenes": int(np.sum(drawn)),
            "compared": int(some.size),
            "share_better": float(np.mean(some < 1)) if some.size else None,
            "ends": int(np.sum(~drawn)) - 1,
            "ends_compared": len(ends),
            "ends_better": sum(x < 1 for x in ends),
            "objective_quantiles": {
                name: float(np.quantile(some, level)) if some.size else None
                for name, level in _LEVELS.items()
            },
            "worst": None if worst is None else {
                "scene": names[worst], "objective": float(values[worst]),
                "values": dict(self.scenes[names[worst]]),
            },
            "keys": rows,
            "decides": max(rows, key=lambda row: abs(row["rank_correlation"] or 0.0))["key"],
            "not_compared": [
                {"scene": name, "values": dict(self.scenes[name])}
                | {f"status_{who}": self.statuses[who][k] for who in (BASELINE, OPTIMIZED)}
                for k, name in enumerate(names) if not known[k]
            ],
            "rivals": [self._rival(name) for name in self.wins],
        }  # fmt: skip

    def _rival(self, name: str) -> dict[str, Any]:
        """Return the record of another design that is better than the optimum in some scenes."""
        lead = self.objectives[OPTIMIZED] - self.objectives[name]
        known = lead[self.drawn & np.isfinite(lead)]
        ranks = {one.key: self._rank(lead, one.key) for one in self.spans}
        wins = {key: parts for key, parts in self.wins[name].items() if parts}
        leads = {one.key: np.nanmax([0.0, *self._ends(lead, k)])
                 for k, one in enumerate(self.spans)}  # fmt: skip
        sizes = {key: leads[key] if wins else abs(ranks[key] or 0.0) for key in (wins or ranks)}
        key = max(sizes, key=lambda one: sizes[one])
        return {
            "name": name,
            "design": self.designs[name],
            "share_better": float(np.mean(known > WINS)) if known.size else None,
            "objective": float(self.objectives[name][0]),
            "key": key,
            "better": wins.get(key, []),
            "rank_correlation": ranks[key],
        }

    @staticmethod
    def _ends(values: NDArray[np.float64], k: int) -> list[float]:
        """Return which of the `values` (n,) are those at low and high end of range `k`."""
        return values[1 + 2 * k : 3 + 2 * k].tolist()

    def _rank(self, values: NDArray[np.float64], key: str) -> float | None:
        """Return Spearman's correlation of `values` (n,) with a quantity over random scenes.

        `None` with fewer than 3 known values, or equal ones."""
        from scipy.stats import spearmanr  # Slow import (0.3 s); the samples need it, too.

        mine = np.array([one.get(key, math.nan) for one in self.scenes.values()])
        kept = self.drawn & np.isfinite(values)
        if np.sum(kept) < 3 or np.ptp(values[kept]) == 0:
            return None
        return float(spearmanr(mine[kept], values[kept]).statistic)  # pyright: ignore
