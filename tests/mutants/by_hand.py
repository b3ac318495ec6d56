"""Mistakes that the tests once missed, and where each is noticed now."""

import dataclasses
from pathlib import Path

from tests.mutants.names import key_of


@dataclasses.dataclass(frozen=True)
class ByHand:
    """One mistake: in `file` the text `was`, which must occur there once, is replaced.

    `function` says what is wrong. `source` is None where the text does not occur once.
    """

    function: str
    file: str
    was: str
    becomes: str
    tests: tuple[str, ...]
    source: str | None = None
    line: int = 0

    @property
    def key(self) -> str:
        """Name that does not change with the line number."""
        return key_of(self.file, self.function, self.was, self.becomes)


_FORMS = ("tests/test_closed_forms.py",)
_SEARCH = "rootsopt/optimize/search.py"
_MISTAKES = (
    ByHand("the multiplier of an orbit of k mesh periods is its k-th root",
           "rootsopt/dynamics/steady.py",
           "multiplier=spectral_radius(orbit.monodromy)",
           "multiplier=spectral_radius(orbit.monodromy) ** (1 / length)", _FORMS),
    ByHand("the multiplier of an orbit of k mesh periods is its k-th power",
           "rootsopt/dynamics/steady.py",
           "multiplier=spectral_radius(orbit.monodromy)",
           "multiplier=spectral_radius(orbit.monodromy) ** length", _FORMS),
    ByHand("a verification accepts always", _SEARCH,
           "if change <= _HOLDS_UP and objective < 1:", "if True:", _FORMS),
    ByHand("a verification accepts what is no better than the baseline", _SEARCH,
           "if change <= _HOLDS_UP and objective < 1:", "if change <= _HOLDS_UP:", _FORMS),
    ByHand("an infeasible trial is taken as the best", _SEARCH,
           "return self.feasible and not np.isnan(self.objective)",
           "return not np.isnan(self.objective)", _FORMS),
    ByHand("`optimizer.seed` is ignored", _SEARCH,
           "sample = sobol(count, seed, len(baseline_point))",
           "sample = sobol(count, 0, len(baseline_point))", _FORMS),
    ByHand("the motor's inertia is dropped from the motion", "rootsopt/dynamics/pair.py",
           "driven = torque / (self.inertia + self.drive.inertia)",
           "driven = torque / self.inertia", _FORMS),
    ByHand("the motor's inertia is dropped from the config", "rootsopt/model.py",
           "inertia=jnp.asarray(scene.motor.inertia_kg_m2),", "inertia=jnp.asarray(0.0),", _FORMS),
    ByHand("the program cache's key lacks the sources", "rootsopt/programs.py",
           "return source.hexdigest(), platform.machine()", 'return "", platform.machine()',
           ("tests/test_programs.py",)),
    ByHand("the program cache's key lacks XLA flags and precision", "rootsopt/programs.py",
           'settings = [os.environ.get("XLA_FLAGS", ""), str(jax.config.read("jax_enable_x64"))]',
           "settings = []", ("tests/test_programs.py",)),
    ByHand("drive and coast columns are exchanged in the file", "rootsopt/files.py",
           '"drive_flank_force_N": series.drive_force,\n'
           '        "coast_flank_force_N": series.coast_force,',
           '"drive_flank_force_N": series.coast_force,\n'
           '        "coast_flank_force_N": series.drive_force,', _FORMS),
    ByHand("drive and coast forces are exchanged in the series", "rootsopt/evaluate.py",
           "drive_force=double(contact.drive),\n        coast_force=double(contact.coast),",
           "drive_force=double(contact.coast),\n        coast_force=double(contact.drive),",
           _FORMS),
    ByHand("the sign of an ensemble's drift", "rootsopt/members.py",
           "drift + jnp.sign(2 * index", "drift - jnp.sign(2 * index", _FORMS),
    ByHand("a factor two in the standard error of an ensemble's RMS", "rootsopt/members.py",
           "by_rms = errors[1] / (2 * rms)", "by_rms = errors[1] / rms", _FORMS),
    ByHand("a factor four in the standard error of the Lyapunov exponent",
           "rootsopt/dynamics/steady.py",
           "error = jnp.std(batches, ddof=1) / 4", "error = jnp.std(batches, ddof=1)", _FORMS),
    ByHand("the covariance of an ensemble's gradient is transposed", "rootsopt/ensemble.py",
           '"ik,rij,jl->rkl"', '"ki,rij,lj->rkl"', _FORMS),
    ByHand("a failing speed of share 0 is ignored", "rootsopt/speeds.py",
           "        if not part.evaluation.usable:",
           "        if part.share > 0 and not part.evaluation.usable:", _FORMS),
    ByHand("the longest gap of a continued orbit is a share of the orbit", "rootsopt/orbits.py",
           "gap_time=_longest_gap(np.asarray(shot.touching)) * self.period,",
           "gap_time=_longest_gap(np.asarray(shot.touching)),", _FORMS),
    ByHand("`map_error` is ten times too large", "rootsopt/evaluate.py",
           "self.map_error = found.error / depth", "self.map_error = 10 * found.error / depth",
           _FORMS),
    ByHand("the error of a map is ten times too large", "rootsopt/contact/size.py",
           "errors.append(float(np.max(", "errors.append(10 * float(np.max(", _FORMS),
    ByHand("joints of a clockwise outline are not reversed", "rootsopt/outline/fit.py",
           "points, joints = points[::-1], joints[::-1]",
           "points, joints = points[::-1], joints", ("tests/test_outline.py",)),
)  # fmt: skip


def by_hand(root: Path) -> list[ByHand]:
    """The mistakes, each with the module that has it."""
    found = []
    for one in _MISTAKES:
        text = (root / one.file).read_text()
        if text.count(one.was) == 1:
            line = text[: text.index(one.was)].count("\n") + 1
            source = text.replace(one.was, one.becomes)
            one = dataclasses.replace(one, source=source, line=line)
        found.append(one)
    return found
