"""Tables of a report on an optimum: constraints, certificate, conflicts, tolerances."""

from collections.abc import Mapping
from typing import Any

from rootsopt.output.labels import in_words
from rootsopt.report.blocks import Block, Cell, block
from rootsopt.report.gather import Run
from rootsopt.report.names import brief, label, quantity, signed, unit, value
from rootsopt.response.sensitivity import MICROMETRE


def constraint_block(run: Run) -> Block | None:
    """Return the constraints of an optimisation, with the price of each limit."""
    rows = []
    for row in run.result.get("constraints") or ():
        word = "met by all" if row.get("always") else "active" if row.get("active") else "satisfied"
        verdict = Cell(word, True) if row["satisfied"] else Cell("violated", False)
        text = f"{in_words(row['name'])} {_sense(row['sense'])} "
        limit = text + quantity(row["limit"], row.get("unit", ""))
        rows.append([limit, value(row["baseline"]), value(row["optimized"]), verdict, _price(row)])
    if not rows:
        return None
    heads = "", "baseline", "optimised", "verdict", "price of the limit"
    note = (
        "Price: change of the objective if the limit is relaxed by the step, to first order. An "
        "empty price: the limit does not hold the optimum back."
    )
    found = run.result.get("optimality") or {}
    if found and not found.get("converged"):
        note += " The design is no optimum, so prices are rough."
    return block("Constraints", heads, [("", rows)], note)


def _sense(sense: str) -> str:
    return {">=": "≥", "<=": "≤"}.get(sense, sense)


def _price(row: Mapping[str, Any]) -> str:
    percent = row.get("relaxed_objective_percent")
    if percent is None or not row.get("multiplier"):
        return ""
    step = signed(row["relaxed_by"], unit(row.get("unit", "")))
    return f"{signed(percent, '%')} for {step}"


def certificate_blocks(run: Run) -> list[Block]:
    """Return tables on the optimum: conditions, active branches, starts, sensitivities."""
    found = run.result.get("optimality")
    if not found:
        return []
    good = bool(found["converged"])
    conditions = [
        ["residual of the first-order conditions", Cell(value(found["residual"]), good),
         f"at most {value(found['required_residual'])}"],
        ["violation of a constraint (scaled)", value(found["violation"]), "0"],
        ["why the search stopped", Cell(in_words(found["reason"]), good), ""],
        ["method", str(found["method"]), ""],
    ]  # fmt: skip
    heads = "", "value", "at an optimum"
    blocks = [block("First-order conditions", heads, [("", conditions)], found["message"])]
    held = [_held(one) for one in found.get("held_by") or ()]
    if len(held) > 1:
        heads = "branch", "share", "its objective"
        note = "Peaks, speeds or motions that are equal at the optimum: none falls alone."
        blocks.append(block("What holds the optimum", heads, [("", held)], note))
    starts = [
        [f"start {one['start']}", Cell(in_words(one["reason"]), one["reason"] == "converged"),
         str(one["evaluations"]), value(one["objective"])]
        for one in found.get("starts") or ()
    ]  # fmt: skip
    optima = [
        [f"optimum {number}", f"found by {one['found']} of {len(starts)} starts", "",
         value(one["objective"])]
        for number, one in enumerate(found.get("optima") or (), start=1)
    ]  # fmt: skip
    heads = "", "why it ended", "designs", "objective"
    groups = [("", starts), ("distinct optima", optima)]
    blocks.append(block("Local searches", heads, groups, _unseen(found)))
    rows = [_sensitive(one) for one in found.get("sensitivities") or ()]
    if rows:
        heads = "", "mean force (N)", "peak force (N)", "objective (%)"
        note = "What a small change of the scene does to the optimised design."
        blocks.append(block("Sensitivity to the scene", heads, [("", rows)], note))
    return blocks


def _held(one: Mapping[str, Any]) -> list[str]:
    parts = []
    if one.get("speed_rpm") is not None:
        parts.append(f"{value(one['speed_rpm'])} rpm")
    if "scene" in one:
        parts.append(f"scene {one['scene']} of the sample")
    if one.get("rotation_deg") is not None:
        parts.append(f"peak of {value(one['force_N'])} N at {one['rotation_deg']:.2f}°")
    return [", ".join(parts) or "motion", f"{one['share']:.3f}", value(one["objective"])]


def _unseen(found: Mapping[str, Any]) -> str:
    share = (found.get("unseen") or {}).get("share_of_starts")
    if share is None:
        return "So few starts do not tell how many optima are left to find (optimizer.starts)."
    return (
        f"About {brief(100 * share, 2)} % of further starts would find an optimum that no start "
        "has found yet (optimizer.starts)."
    )


def _sensitive(one: Mapping[str, Any]) -> list[str]:
    step = "+1 µm" if one["unit"] == "mm" and one["step"] == MICROMETRE else "+1 %"
    percent = one.get("objective_percent")
    cells = [signed(one[key], "") for key in ("mean_force_N", "peak_force_N")]
    cells.append("–" if percent is None else signed(percent, ""))
    return [f"{one['quantity']} {step}", *cells]


def conflict_block(run: Run) -> Block | None:
    """Return the constraints in conflict, with the nearest limits that can be met, or None."""
    rows = [
        [f"{in_words(row['name'])} {_sense(row['sense'])} {quantity(row['limit'], row['unit'])}",
         value(row["together"]), value(row["alone"])]
        for row in (run.result.get("infeasible") or {}).get("conflicts") or ()
    ]  # fmt: skip
    if not rows:
        return None
    heads = "constraint", "with the least violation", "possible with all others"
    return block("Constraints in conflict", heads, [("", rows)])


def tolerance_blocks(run: Run) -> list[Block]:
    """Return the designs' results in fresh scenes with scattered values, or an empty list."""
    fresh = (run.result.get("robustness") or {}).get("fresh") or {}
    if not fresh:
        return []
    groups = []
    for name in ("objective", "mean_force_N", "peak_force_N"):
        keys = [*next(iter(fresh.values()))[name]]
        rows = [[in_words(key), *(value(one[name][key]) for one in fresh.values())] for key in keys]
        groups.append((label(name), rows))
    shares = [f"{100 * one['failed_share']:.3g} %" for one in fresh.values()]
    groups.append(("scenes", [["without a usable motion", *shares]]))
    count = next(iter(fresh.values()))["scenes"]
    return [block(f"Designs in {count} fresh scenes", ["", *fresh], groups)]
