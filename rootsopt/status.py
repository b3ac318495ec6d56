"""Statuses of results. Every result has one status."""

import enum
import operator
from typing import SupportsIndex


class Status(enum.Enum):
    """Outcome of a simulation or a search. Each value explains the status and advises the user.

    >>> import rootsopt
    >>> rootsopt.Status.CHAOTIC.label, rootsopt.Status.CHAOTIC.usable
    ('chaotic', False)
    """

    PERIODIC = "The pair settled on a stable periodic orbit."
    AVERAGED = (
        "The forces are averages over an ensemble of motions, with standard errors. The gradient "
        "is that of the average over a neighbourhood of the design."
    )
    GEOMETRY_ONLY = "The profile is valid; nothing was simulated."
    CHAOTIC = (
        "The motion is chaotic: mean and peak are those of a finite window and have no usable "
        "gradient. Set objective.motion to ensemble to optimise averages over an ensemble of "
        "motions. Or lower the speed, load or backlash, or add damping."
    )
    NOT_SETTLED = (
        "The motion has not settled within the allowed time. Raise solver.max_mesh_periods, or add "
        "damping."
    )
    PASSED_THROUGH = (
        "The lobes passed through each other: nothing holds them against this load. Add a "
        "scene.timing_gear or raise its stiffness, or lower the load or the backlash."
    )
    STALLED = (
        "The motor has stalled: it cannot carry the load. Raise scene.motor.torque_N_m or "
        "slope_N_m_s_per_rad, or lower the load."
    )
    TOO_DEEP = (
        "The flanks penetrate too deep for a contact law to be valid (2 % of the pitch radius). "
        "Raise contact.stiffness_N_per_mm_e or lower the load. If the axes are too close, raise "
        "scene.center_distance_error_mm."
    )
    UNRESOLVED = (
        "The force is not resolved: either the flanks penetrate so little that rounding of the gap "
        "changes its greatest value by more than 1 %, or the steps are too coarse for its impacts "
        "(mean, RMS and peak contradict each other). Tighten solver.accuracy."
    )
    INACCURATE = (
        "The orbit is closed, but halving the solver's steps changes it or its derivatives: they "
        "are not accurate enough to be reported. Tighten solver.accuracy, or raise "
        "contact.smoothing_mm or solver.max_steps_per_period."
    )
    IDLE = "No flank touches: the contact force is zero."
    NOT_IMPROVED = (
        "No feasible design better than the baseline was found. Lower "
        "constraints.area_efficiency_min, widen optimizer.bounds, or raise optimizer.screening."
    )
    INTERRUPTED = (
        "The search was stopped before its end; the best design found until then is reported. Run "
        "the search again for the optimum."
    )
    SOLVER_FAILED = (
        "The solver ran out of steps. Raise solver.max_steps_per_period (it needs at least "
        "ten for each of statistics.swings_per_mesh_period), or loosen solver.accuracy."
    )
    NON_FINITE = (
        "The simulation produced a number that is not finite. Loosen solver.accuracy or check the "
        "contact parameters."
    )

    NOT_CONVERGED = (
        "The design is better than the baseline, but the first-order conditions of an optimum do "
        "not hold there: optimality.message of result.json says why, and what to do."
    )
    INFEASIBLE = (
        "No design satisfies all constraints. `infeasible` of result.json lists those that are in "
        "conflict, and the nearest limits that can be met. Relax one of them."
    )
    INVALID = (
        "This point of the sweep has no valid config: its values do not fit each other, or the "
        "profile is not sound."
    )
    FAILED = "This point of the sweep ended with an error, or ended the processes that ran it."
    NOT_SIMULATED = (
        "The sweep was stopped before this point. Run it again with --resume for the missing "
        "points."
    )
    UNSOUND = (
        "The profile is not sound, so nothing was simulated: a margin of its geometry is negative. "
        "Change the design until all margins are positive."
    )

    NOT_CLOSED = (
        "The motion repeats, but its orbit could not be closed, so that the forces are those of a "
        "window of the motion, and their gradient is not known. Change solver.accuracy, or move "
        "the scene a little."
    )

    IDENTIFIED = "The quantities are those of the scene that fits the record best."
    NOT_IDENTIFIED = (
        "No scene within the bounds fits the record. Widen the bounds, fit further quantities, or "
        "check units and signs of the columns."
    )

    @property
    def code(self) -> int:
        """Number that represents the status in arrays."""
        return list(Status).index(self)

    @classmethod
    def of(cls, code: SupportsIndex) -> "Status":
        """Return the status with this `code`.

        Raises `ValueError` if there is no such status."""
        number = operator.index(code)
        if not 0 <= number < len(cls):
            raise ValueError(
                f"Argument `code` must be a status code from 0 to {len(cls) - 1}, but is {number}"
            )
        return list(cls)[number]

    @property
    def meaning(self) -> str:
        """What the status means: its first sentence, before the advice."""
        return self.value.partition(". ")[0].removesuffix(".") + "."

    @property
    def usable(self) -> bool:
        """Whether a result with this status is the requested one, with a gradient."""
        evaluated = Status.PERIODIC, Status.AVERAGED, Status.IDLE, Status.GEOMETRY_ONLY
        return self in (*evaluated, Status.IDENTIFIED)

    @property
    def label(self) -> str:
        """Name of the status in result files and tables."""
        return self.name.lower()


class Standing(enum.Enum):
    """Status of one point of a front. Each value explains it and advises the user."""

    CERTIFIED = (
        "No compromise nearby is better, and the first-order conditions hold. The search for the "
        "point had converged."
    )
    NOT_CERTIFIED = (
        "The design is the best that was found for this compromise, but its search had not "
        "converged, or the first-order conditions do not hold. Raise optimizer.iterations or "
        "tighten solver.accuracy."
    )
    NOT_VERIFIED = (
        "The search was stopped before the design was simulated again from rest. Run it again."
    )
    DOMINATED = "Another point is at least as good in every term and better in one."
    REPEATED = "Another point is the same design."
    NOT_HELD_UP = (
        "Simulated from rest at the tight tolerance, the design has no usable steady state, or "
        "forces other than in the search. Tighten solver.accuracy."
    )

    @property
    def label(self) -> str:
        """Name of the status in result files and tables."""
        return self.name.lower()

    @property
    def kept(self) -> bool:
        """Whether a point with this status stays on the front."""
        return self in (Standing.CERTIFIED, Standing.NOT_CERTIFIED, Standing.NOT_VERIFIED)
