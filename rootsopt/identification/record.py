"""A measured record: measured values at operating points.

A record is one table or several. Columns named after config keys, such as `scene.speed_rpm`, say at
which operating point a row was measured. A table with rotations or times holds samples of a motion:
`CHANNELS` along a closed orbit, with derivatives along directions of the pair. Any other table
holds averages, a row per operating point."""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config.document import read_document
from rootsopt.config.explain import tree
from rootsopt.config.reading import Config
from rootsopt.config.sources import reason, regular_file
from rootsopt.config.units import named, near, shown
from rootsopt.dynamics.collocation.elements import BLOCK
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import VariedOrbit
from rootsopt.errors import InputError
from rootsopt.measured.table import measured_number, titled
from rootsopt.response.terms import GEAR, RESERVES, is_force
from rootsopt.runtime.programs import CachedFunction

CHANNELS = (
    "relative_rotation_rad", "relative_speed_rad_s", "drive_flank_force_N", "coast_flank_force_N",
    "contact_force_N", "penetration_m", "gear_torque_N_m", "shaft_torque_N_m",
)  # fmt: skip
"""Names of the sampled quantities: the columns of a response, then the torque of the timing gear on
rotor 1 and that of the shaft that drives rotor 1."""

# Number of samples computed by one call of the program, so that one program serves records of any
# length.
_TOGETHER = 8 * BLOCK


def channels_at(
    pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit, tau: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the `CHANNELS` (n, c) at the times `tau` (n,), in mesh periods, and their derivatives.

    The derivatives (n, c, d + 1) are those along the directions `tangents` of the variation of the
    `orbit`, then that with respect to time."""
    # The orbit and the rotors repeat together after this time. Reducing the times by it keeps their
    # rounding errors small.
    times = orbit.elements.mesh.times
    tau = np.mod(tau, pair.lobes * np.round(float(times[-1] - times[0])))
    padded = np.pad(tau, (0, -len(tau) % _TOGETHER))
    chunks = [_channels(pair, tangents, orbit, some) for some in padded.reshape(-1, _TOGETHER)]
    values, slopes = zip(*jax.device_get(chunks), strict=True)
    return np.concatenate(values)[: len(tau)], np.concatenate(slopes)[: len(tau)]


@CachedFunction
def _channels(pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit, tau: Any):
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
    directions = eqx.filter(tangents, eqx.is_inexact_array)
    still = jax.tree.map(lambda x: jnp.pad(x, ((0, 1),) + ((0, 0),) * (x.ndim - 1)), directions)

    def values(tau, state, dynamic):
        return _values(eqx.combine(dynamic, static), tau, state)

    def at(tau):
        state, rate, along = orbit.at(tau)
        times = jnp.append(jnp.zeros(along.shape[-1]), 1.0)
        changes = jnp.concatenate([along, rate[:, None]], axis=1)

        def push(time, change, moved):
            return jax.jvp(values, (tau, state, dynamic), (time, change, moved))

        return jax.vmap(push, (0, 1, 0), (None, -1))(times, changes, still)

    return lax.map(at, tau, batch_size=BLOCK)


def _values(pair: RotorPair, tau, state) -> Float[Array, " c"]:
    """Return the `CHANNELS` at a time (mesh periods) and scaled state."""
    motion, contact = pair.motion(tau, state), pair.contact_at(tau, state)
    nothing = jnp.zeros_like(motion.relative)
    gear = nothing if pair.gear is None else pair.gear.torque_on_1(motion, np.zeros(0))
    if pair.free:
        shaft = pair.drive.torque_on_1(motion, np.zeros(0))
    else:  # Rotor 1 turns uniformly: the shaft balances all other torques on it.
        each = zip(pair.all_parts, pair.own_states(state), strict=True)
        torques = [part.torque_on_1(motion, own) for part, own in each]
        shaft = -functools.reduce(jnp.add, [x for x in torques if x is not None], contact.torque1)
    assert gear is not None
    assert shaft is not None
    forces = contact.drive, contact.coast, contact.total
    return jnp.stack([motion.relative, motion.rate, *forces, contact.depth, gear, shaft])


# Columns of a table of samples, as in `response_*.csv`; the time counts only without rotation.
_ROTATION, _TIME = "rotation_deg", "time_s"

# Ending of the names of columns with standard deviations, which `_sd` stands for, too.
_SPREAD = "_std"

# Number of samples at an operating point above which only every second, third … one is used.
_MOST = 4096

# Rotation (°) in 1 s at 1 rpm.
_DEGREES_PER_RPM = 6.0

# Distance (mesh periods) from an instant below which samples are used to find its state, and number
# of samples needed.
_BESIDE, _ENOUGH = 0.1, 6
_AVERAGES = *RESERVES, *GEAR


@dataclasses.dataclass(frozen=True)
class Observed:
    """What was measured at one operating point.

    `source`: name of the table; `values`: config keys that differ from the config; `table`: numbers
    by line, with the columns `names` and their standard deviations; `sampled`: whether the lines
    are samples, with a column for the rotation (°) of rotor 1, rather than averages."""

    source: str
    values: dict[str, Any]
    table: pandas.DataFrame
    names: tuple[str, ...]
    sampled: bool

    def column(self, name: str = _ROTATION) -> NDArray[np.float64]:
        """Return a column (n,), by default the rotation; NaN where nothing was measured."""
        return np.array(self.table.get(name, np.full(len(self.table), np.nan)), float)

    @property
    def timed(self) -> bool:
        """Whether the rotation follows from the time."""
        return _TIME in self.table

    @property
    def measured(self) -> NDArray[np.float64]:
        """The measured values (n, c)."""
        return np.stack([self.column(name) for name in self.names], axis=1)

    def rows(self) -> pandas.DataFrame:
        """Return a row for each measured value: `source`, `line`, `values`, `rotation_deg`,
        `column`, `measured`, standard deviation (`given`, NaN if not known), and `sampled`."""
        measured = self.measured
        given = np.stack([self.column(name + _SPREAD) for name in self.names], axis=1)
        k, c = np.nonzero(np.isfinite(measured))
        where = {"source": self.source, "line": self.table.index[k]} | self.values
        where |= {"rotation_deg": self.column()[k], "column": np.array(self.names)[c]}
        columns = {"measured": measured[k, c], "given": given[k, c], "sampled": self.sampled}
        return pandas.DataFrame(where | columns)

    def state(
        self, lobes: int, turns: int, period: float, offset: float
    ) -> NDArray[np.float64] | None:
        """Return ε (rad) and dε/dt (rad/s) at a φ1 that is a multiple of `turns` mesh periods.

        They follow from cubics through neighbouring samples; None unless enough samples of ε are
        known. `lobes` of a rotor; `period` (s) of the mesh; `offset` (°): rotation at φ1 = 0."""
        place, relative, rate = map(self.column, (_ROTATION, *CHANNELS[:2]))
        place = (place - offset) * lobes / 360
        number = np.round(place / turns)
        away = place - turns * number
        near = np.isfinite(relative) & (np.abs(away) < _BESIDE)
        if np.count_nonzero(near) < _ENOUGH:
            return None
        most = pandas.Series(number[near]).value_counts()
        # Combine sparse samples from several mesh periods.
        near &= (number == most.index[0]) | (most.iloc[0] < _ENOUGH)
        *_, speed, angle = np.polyfit(away[near], relative[near], 3)
        near &= np.isfinite(rate)
        if np.count_nonzero(near) >= _ENOUGH:
            return np.array([angle, np.polyfit(away[near], rate[near], 3)[-1]])
        return np.array([angle, speed / period])


def observed(config: Config, data: Any) -> list[Observed]:
    """Return the measurements at each operating point.

    `data`: path of a CSV file, columns by name (a mapping or an `xarray.Dataset`), or a list of
    these. Raises `InputError` if a table cannot be read, or if a column or a value is wrong."""
    tables = data if isinstance(data, list | tuple) else [data]
    measurements = []
    for number, one in enumerate(tables, 1):
        measurements += _points(config, *_table(one, f"table {number} of the record"))
    if not measurements:
        raise InputError("the record must hold measured values, but has none; add rows")
    return measurements


def _table(data: Any, name: str) -> tuple[str, pandas.DataFrame]:
    """Return the name and the cells of a table, as text with line numbers."""
    if not isinstance(data, str | Path):
        columns = data.variables if hasattr(data, "variables") else data
        cells = {str(key): np.atleast_1d(np.asarray(data[key])).tolist() for key in columns}
        if len({len(column) for column in cells.values()}) > 1:
            raise InputError(f"{name}: must have columns of one length; correct them")
        return name, pandas.DataFrame(cells, dtype=object).map(
            lambda x: "" if x is None else str(x)
        )
    path = Path(data)
    try:
        content = regular_file(path, "a table").read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(
            f"{named(str(path))}: must be a file that can be read: {reason(error)}; give the path "
            "of a CSV file"
        ) from None
    titles, rows = titled(content, path.name, "of the record")
    if len({*titles}) < len(titles):
        twice = next(title for title in titles if titles.count(title) > 1)
        raise InputError(f"{path.name}: must name each column once, but has {twice!r} twice")
    rows = {n: (cells + [""] * len(titles))[: len(titles)] for n, cells in rows.items()}
    return path.name, pandas.DataFrame.from_dict(rows, orient="index", columns=titles)


def _points(config: Config, name: str, cells: pandas.DataFrame) -> Iterator[Observed]:
    """Yield the operating points of a table in the order of their first rows."""
    cells = cells.rename(
        columns=lambda x: x.removesuffix("_sd") + _SPREAD if x.endswith("_sd") else x
    )
    sampled, titles = bool({_ROTATION, _TIME} & {*cells}), [*cells]
    keys = [title for title in titles if title in tree(Config)]
    known = {_ROTATION, _TIME, *keys, *(title + _SPREAD for title in titles)}
    names = tuple(title for title in titles if title not in known)
    if not sampled and (samples := [title for title in names if title in CHANNELS]):
        raise InputError(
            f"{name}: the samples {samples[0]} need a column {_ROTATION} or {_TIME}; add it, or "
            "rename the one that holds it"
        )
    for title in names:
        _check(config, name, title, sampled)
    if not names:
        some = CHANNELS[0] if sampled else "mean_force_N"
        raise InputError(f"{name}: must have a measured column, such as {some}; add one")
    table = cells.drop(columns=keys).map(measured_number).astype(float)
    for title, column in table.items():
        wrong, what = column.abs() == np.inf, "a number"
        if str(title).endswith(_SPREAD):
            measured = table[str(title).removesuffix(_SPREAD)].notna()
            wrong, what = wrong | measured & ~(column > 0), "a number greater than 0"
        if wrong.any():
            line = wrong.idxmax()
            raise InputError(
                f"{name}, line {line}: {title} must be {what}, but is "
                f"{shown(cells.at[line, title])}; correct it, or remove the row"
            )
    groups = cells.groupby(keys or (lambda _: 0), sort=False) if sampled else cells.groupby(level=0)
    for _, rows in groups:
        values = {key: read_document(rows[key].iloc[0], name) for key in keys}
        config.check_values({key: x for key, x in values.items() if x is not None})
        part = table.loc[rows.index].dropna(how="all", subset=names)
        part = part.drop(columns=_TIME, errors="ignore") if _ROTATION in part else part
        if sampled and _ROTATION not in part:
            if config.scene.motor is not None:
                raise InputError(f"{name}: must have the column {_ROTATION}, because the speed of "
                                 "a motor varies; add it")  # fmt: skip
            speed = values.get("scene.speed_rpm") or config.scene.speed_rpm
            part = part.assign(**{_ROTATION: _DEGREES_PER_RPM * speed * part[_TIME]})
        part = part.dropna(subset=[_ROTATION]) if sampled else part
        if len(part):
            some = part.iloc[:: -(-len(part) // _MOST)]
            yield Observed(name, values, some, names, sampled)


def _check(config: Config, name: str, title: str, sampled: bool) -> None:
    """Raise `InputError` unless `title` is that of a measured column."""
    if title in (CHANNELS if sampled else _AVERAGES) or (
        not sampled and is_force(config, title, name)
    ):
        return
    told = CHANNELS if sampled else ("mean_force_N", "peak_force_N", "rms_force_N", *_AVERAGES)
    meant = near(title, [*tree(Config)] if "." in title else [*told])
    raise InputError(
        f"{name}: the column {named(title)!r} must be {'a sample' if sampled else 'an average'} "
        f"({', '.join(told)}), a config key, or one of these with {_SPREAD} for its standard "
        f"deviations; {f'did you mean {meant}?' if meant else 'rename or remove it'}"
    )
