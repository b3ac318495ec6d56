"""Measures how far flanks are from being conjugate, and reports it for an imported outline.

The measure is the gap of the flanks in pure rolling."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float64

from rootsopt.config.reading import Config
from rootsopt.contact.closest import FlankPair
from rootsopt.errors import InputError
from rootsopt.profiles import Profile
from rootsopt.runtime.programs import CachedFunction

_MICRON = 1e-6

# Limits above which flanks count as cut by an inset; both must be exceeded. First: the inset (m).
# Second: its ratio to the standard deviation of the gap over the mesh, a robust estimate.
_CERTAIN = 1e-6, 1.5

# Ratio of the standard deviation to the median of the absolute values, for a normal distribution.
_SPREAD = 1.4826

# Number of roll angles at which the gap is measured.
_POSES = 361


@dataclasses.dataclass(frozen=True)
class Conjugacy:
    """Gap of a pair in pure rolling: relative rotation ε = 0, nominal centre distance.

    `roll` (n,): roll angle (rad) of rotor 1 over a quarter of a lobe pitch, 0 with a tip of rotor 1
    on the line of centres. By symmetry, the other three quarters give the same gaps, with the
    rotors or the flanks exchanged.
    `gap` (n,): gap (m) of the drive flanks or of the coast flanks, whichever is smaller; negative
    if they overlap, NaN if neither pair of flanks has points that face each other.
    """

    roll: Float64[np.ndarray, " n"]
    gap: Float64[np.ndarray, " n"]

    @property
    def least(self) -> float:
        """Least gap (m) over all roll angles, negative if flanks overlap."""
        return float(np.nanmin(self.gap))

    @property
    def most(self) -> float:
        """Greatest gap (m) over all roll angles."""
        return float(np.nanmax(self.gap))

    @property
    def inset(self) -> float:
        """Distance (m) along the normal by which both rotors are smaller than conjugate ones.

        Half the median gap: rotors are often cut with their clearance. Negative for oversize; 0 if
        the gap varies too much over the mesh to tell."""
        median = np.nanmedian(self.gap)
        spread = _SPREAD * np.nanmedian(np.abs(self.gap - median))
        least, ratio = _CERTAIN
        return float(median / 2) if abs(median / 2) > max(least, ratio * spread) else 0.0

    def record(self) -> dict[str, float]:
        """Return the gap's statistics for the result file.

        `inset_um`: see `inset` (µm).

        `mesh_gap_min_um`, `mesh_gap_max_um`: least and greatest gap (µm). `mesh_gap_min_at_deg`,
        `mesh_gap_max_at_deg`: roll angles (°) of these gaps. `interference_um`: greatest overlap
        (µm), 0 without overlap. `backlash_um`: twice the least gap (µm), 0 with overlap. It is the
        play, along the normal, of a lobe between the partner's two lobes."""
        return {
            "inset_um": self.inset / _MICRON,
            "mesh_gap_min_um": self.least / _MICRON,
            "mesh_gap_min_at_deg": float(np.degrees(self.roll[np.nanargmin(self.gap)])),
            "mesh_gap_max_um": self.most / _MICRON,
            "mesh_gap_max_at_deg": float(np.degrees(self.roll[np.nanargmax(self.gap)])),
            "interference_um": max(0.0, -self.least) / _MICRON,
            "backlash_um": max(0.0, 2 * self.least) / _MICRON,
        }


def inset_note(inset: float, clearance_mm: float) -> str:
    """Return a sentence on an `inset` (m) and the config's clearance; "" without an inset."""
    if not inset:
        return ""
    size, gap = f"inset {inset * 1e3:.3g} mm", clearance_mm + 2e3 * inset
    if gap < 0:
        return (
            f"outline: {size} (oversize): both rotors are larger than conjugate ones by this "
            f"distance, and their flanks overlap; raise `contact.clearance_mm` by {-gap:.4g}"
        )
    return (
        f"outline: {size}: both rotors are cut smaller than conjugate ones by this distance; "
        f"conjugate flanks have the same gap with `--set contact.clearance_mm={gap:.4g}`"
    )


def conjugacy(profile: Profile, distance: float | None = None) -> Conjugacy:
    """Return the gap between the flanks of two equal rotors in pure rolling.

    `profile`: profile of both rotors; `distance`: centre distance (m), by default twice the pitch
    radius. Raises `InputError` if the flanks never face each other."""
    roll = float(profile.half_pitch) * (np.arange(_POSES) + 0.5) / _POSES
    apart = 2 * profile.pitch_radius if distance is None else jnp.asarray(distance)
    gap, facing = map(np.asarray, _gaps(profile, apart, jnp.asarray(roll)))
    facing = facing & np.isfinite(gap)
    if not np.any(facing):
        raise InputError(
            "`profile.pitch_radius_mm` must be half the centre distance at which the rotors mesh, "
            "but their flanks do not face each other there; check this key and the outline's units"
        )
    return Conjugacy(roll, np.where(facing, gap, np.nan))


@CachedFunction
def _gaps(profile, distance, roll):
    pair = FlankPair.of(profile, distance, two_sided=True)
    sides = jnp.stack([roll, -roll])
    contact = lax.map(lambda x: pair(x, jnp.zeros_like(x)), sides.ravel())
    gap = jnp.where(contact.found, contact.gap, jnp.inf).reshape(sides.shape)
    return jnp.min(gap, axis=0), jnp.any(contact.found.reshape(sides.shape), axis=0)


def record(config: Config) -> dict[str, Any]:
    """Return {"outline": {...}} for the result file: the records of `Checks` and `Conjugacy`.

    Return {} if the config names no outline file."""
    if not config.profile.from_file:
        return {}
    from rootsopt.measured.source import outline_of  # For outlines only: it takes 0.5 s.

    profile, checks = outline_of(config.profile)
    return {"outline": checks.record() | conjugacy(profile).record()}


def notes(config: Config) -> list[str]:
    """Return notes on an imported outline; none without one.

    They say whether its flanks differ by 1 µm or more, whether its points scatter, and whether its
    centre is not the rotor's axis. They also say whether a clearance was drawn into it."""
    if not config.profile.from_file:
        return []
    from rootsopt.measured.source import advice, outline_of  # Slow import, as in `record`.

    profile, checks = outline_of(config.profile)
    texts = advice(config.profile, checks)
    if not checks.seen.off_center:
        texts += filter(None, [inset_note(conjugacy(profile).inset, config.contact.clearance_mm)])
    return texts
