"""Fronts of contact force, leakage and flow ripple, for every profile family in the same pump.

The pump has pitch radius, length, clearance, gear and bore of `configs/cic.yaml`; it delivers air
against 0.5 bar. The load is the mean torque of the gas, which is the same for all rotors of one
displacement. Every design displaces at least the volume of the EE rotor. Area efficiency and seal
width have no limits: displacement and leakage take their place.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments._common.driver import Run
from experiments._common.scenes import FAIR
from experiments._common.style import BLACK, COLORS, GREY, MARKS, sheet
from experiments._common.tables import Row, show
from rootsopt.config import Config, load
from rootsopt.config.families import family_of
from rootsopt.errors import InputError
from rootsopt.optimize.design import pareto_front
from rootsopt.pump.sheet import sheet as pump_sheet
from rootsopt.response.evaluation import Evaluator
from rootsopt.scene import Scene, design_vector

# Terms of the trade-off; less of each is better.
TERMS = "mean_force_N", "leakage_fraction", "flow_ripple"

# Family without design parameters, whose volume all designs displace.
REFERENCE = "ee"

# Steps between two ends of a front: 10 points.
DIVISIONS = 3
FAMILIES = "cic", "arc_involute", "five_arcs"

# Families of a reduced run.
QUICK = ("arc_involute",)
_PUMP = (
    "scene.load={torque_N_m: 2.0}",
    "pump={viscosity_mPa_s: 0.018, pressure_difference_Pa: 5.0e4, tip_clearance_mm: 0.08, "
    "end_clearance_mm: 0.05, gas: {inlet_pressure_Pa: 1.0e5}}",
    "optimizer={iterations: 30, starts: 1, screening: 8, seed: 0}",
    "constraints.area_efficiency_min=0.0",
    "constraints.seal_width_min_mm=0.0",
    f"pareto.terms=[{', '.join(TERMS)}]",
    "pareto.refinements=0",
)


def config_of(family: str, divisions: int = DIVISIONS) -> Config:
    """Return the config of a `family`; `divisions`: steps between two ends of its front."""
    values = {
        key: [*v] if isinstance(v, tuple) else v for key, v in family_of(family).example.items()
    }
    profile = {"family": family, "lobes": 3, "pitch_radius_mm": 33.0, **values}
    return load(FAIR, [f"profile={profile!r}", *_PUMP, f"pareto.divisions={divisions}"])


def row_of(config: Config, terms: dict[str, float], geometry_of: dict[str, float]) -> Row:
    """Return the columns that every row has, for the design of a `config`.

    `terms`, `geometry_of`: its terms, and its geometry with the keys of the result file."""
    found = pump_sheet(Scene.from_config(config), design_vector(config))
    return {
        **terms,
        "displaced_volume_cm3": found["displaced_volume_cm3"],
        "radius_ratio": geometry_of["outer_radius_mm"] / config.profile.pitch_radius_mm,
        **{key: geometry_of[key] for key in ("area_efficiency", "seal_width_mm")},
    }


def front_of(
    family: str, volume: float, divisions: int, say: Callable[[str], None]
) -> Iterator[Row]:
    """Yield the rows of the best compromises of a `family`; none if it cannot displace the volume.

    `volume`: least volume (cm³) displaced per revolution; `say`: function that reports progress."""
    config = config_of(family, divisions).replaced(
        {"constraints.terms": {"displaced_volume_cm3": {"min": volume}}}
    )
    front = pareto_front(config)
    say(f"{family}: {front.searches} searches, {front.evaluations} designs. {front.message}")
    for point in front.points:
        yield {
            "family": family,
            "point": point.number,
            "status": point.standing.label,
            **row_of(front.config_of(point), point.terms, point.evaluation.geometry),
            "peak_force_N": point.evaluation.response["peak_force_N"],
            **point.design,
        }


def reference() -> Row:
    """Return the row of the reference, which is a single design."""
    config = config_of(REFERENCE)
    found = Evaluator.of(config.replaced({"objective.terms": dict.fromkeys(TERMS[1:], 0.1)}))()
    shown = {name: found.response[name] for name in (*TERMS, "peak_force_N")}
    row = {"family": REFERENCE, "point": 1, "status": found.status.label}
    return row | row_of(config, shown, found.geometry)


def mark_best(rows: Sequence[Row]) -> None:
    """Set `best_of_all` in every row: whether no design of any family is better in all terms.

    Rows that are equal in a term count as equal, not as better."""
    values = np.array([[row[name] for name in TERMS] for row in rows])
    for row, own in zip(rows, values, strict=True):
        beaten = np.all(values <= own, axis=1) & np.any(values < own, axis=1)
        row["best_of_all"] = not bool(beaten.any())


_LABELS = {
    "mean_force_N": ("mean contact force (N)", 1.0),
    "leakage_fraction": ("leakage (% of the flow)", 100.0),
    "flow_ripple": ("flow ripple (%)", 100.0),
    "radius_ratio": ("outer radius / pitch radius", 1.0),
}
_PANELS = (
    ("leakage_fraction", "mean_force_N"),
    ("flow_ripple", "mean_force_N"),
    ("flow_ripple", "leakage_fraction"),
    ("radius_ratio", "flow_ripple"),
)
_EFFICIENCIES = 0.35, 0.40, 0.45, 0.50


def fronts(rows: list[Row]) -> Figure:
    """Draw all best compromises, filled if no other family has a better one.

    The last panel shows that outer radius and area efficiency fix the ripple."""
    made, axes = sheet(11, 8.6, 2, 2)
    families = [*dict.fromkeys(row["family"] for row in rows if row["family"] != REFERENCE)]
    styles = {name: (COLORS[k % 6], MARKS[k % 7], 6) for k, name in enumerate(families)}
    styles[REFERENCE] = BLACK, "*", 11
    for ax, (x, y) in zip(axes.ravel(), _PANELS, strict=True):
        for row in rows:
            color, mark, size = styles[row["family"]]
            at = [_LABELS[key][1] * row[key] for key in (x, y)]
            fill = color if row["best_of_all"] else "none"
            ax.plot(*at, mark, color=color, markerfacecolor=fill, ms=size, zorder=3)
        ax.set(xlabel=_LABELS[x][0], ylabel=_LABELS[y][0])
    _iso_efficiency(axes[1, 1])
    plain: dict[str, Any] = {"color": GREY, "marker": "o", "linestyle": ""}
    entries = [
        *(Line2D([], [], color=color, marker=mark, linestyle="", label=name.replace("_", " "))
          for name, (color, mark, _) in styles.items()),
        Line2D([], [], label="best of all families", **plain),
        Line2D([], [], label="best of its family", markerfacecolor="none", **plain),
    ]  # fmt: skip
    made.legend(handles=entries, loc="outside lower center", ncols=6, frameon=False)
    return made


def _iso_efficiency(ax: Axes) -> None:
    """Draw the closed form of the ripple over the radius ratio at several area efficiencies."""
    (low, high), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    ratio = np.linspace(low, high, 200)
    for eta in _EFFICIENCIES:
        ripple = 100 * (ratio - 1) ** 2 / (eta * ratio**2)
        ax.plot(ratio, ripple, color=GREY, linewidth=0.8, zorder=1)
        inside = np.flatnonzero((ripple > bottom) & (ripple < top))
        if inside.size > len(ratio) / 4:
            place = inside[int(0.7 * inside.size)]
            beside = {"textcoords": "offset points", "xytext": (4, -4), "fontsize": 8}
            ax.annotate(f"η = {eta:.2f}", (ratio[place], ripple[place]), color="0.3", **beside)
    ax.set(xlim=(low, high), ylim=(bottom, top))


# Columns of the printed table.
SHOWN = (
    *("family", "point", "mean_force_N", "peak_force_N", "leakage_fraction", "flow_ripple"),
    *("radius_ratio", "area_efficiency", "displaced_volume_cm3", "status", "best_of_all"),
)


def run(job: Run) -> None:
    """Trace the fronts of all `FAMILIES`; write and print a row per best compromise.

    A reduced run has one family, and as few points as a front of three terms can have."""
    rows = [reference()]
    volume = rows[0]["displaced_volume_cm3"]
    job.say(f"{REFERENCE}: {volume:.4g} cm³ per revolution")
    for family in QUICK if job.quick else FAMILIES:
        try:
            rows += front_of(family, volume, 2 if job.quick else DIVISIONS, job.say)
        except InputError as error:
            job.say(f"{family}: {error}")
    mark_best(rows)
    job.csv("pump_front.csv", rows)
    job.figure("pump_front.png", fronts(rows))
    show("Best compromises of every family", rows, SHOWN)
