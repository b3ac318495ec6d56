"""Stand-ins for a pair and an evaluation, with numbers made up for a test, and what counts as a
failure of the package on odd input.

A pair whose flanks never touch is a damped oscillator."""

import contextlib
import signal
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import families
from rootsopt.contact.gap import Contact
from rootsopt.contact.law import ImpactLaw
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.parts import ConstantLoad, PrescribedDrive, TimingGear
from rootsopt.errors import InputError
from rootsopt.response import terms
from rootsopt.response.evaluation import _motion, build
from rootsopt.response.result import RESPONSES, Evaluation
from rootsopt.response.terms import Term, register_term
from rootsopt.status import Status

ROOT = Path(__file__).parents[1]
LOBES, SPEED, INERTIA, STIFFNESS, DAMPING, LOAD = 3, 300.0, 2e-3, 2e3, 1.5, 0.4
HALF_BACKLASH, SCALE = 1e-3, 5e-3
LONGEST = 500
"""Length (characters) of a message above which it counts as a failure."""


class Far(Contact):
    """Stand in for a contact whose flanks are a metre apart in every position."""

    def __call__(self, roll, relative):
        return jnp.ones_like(roll), jnp.zeros_like(roll), jnp.zeros_like(roll)


def oscillator(**changes) -> RotorPair:
    """Return a pair whose rotors are coupled by the gear alone."""
    gear = TimingGear(*(jnp.asarray(x) for x in (STIFFNESS, DAMPING, HALF_BACKLASH, 1e-6)))
    parts = {
        "lobes": LOBES,
        "contact": Far(),
        "law": ImpactLaw(*(jnp.asarray(x) for x in (1e9, 1.5, 100.0, 1e-5, 1e-7))),
        "clearance": jnp.asarray(0.0),
        "inertia": jnp.asarray(INERTIA),
        "drive": PrescribedDrive(jnp.asarray(SPEED)),
        "load": ConstantLoad(jnp.asarray(LOAD)),
        "gear": gear,
        "angle_scale": jnp.asarray(SCALE),
        "force_scale": jnp.asarray(100.0),
    }
    return RotorPair(**parts | changes)


class Near(Contact):
    """Stand in for a contact that overlaps by 0.03 m times the relative rotation."""

    def __call__(self, roll, relative):
        return 0.03 * relative, 0.03 * jnp.ones_like(roll), 0.03 * jnp.ones_like(roll)


def evaluation_of(force=1.0, status=Status.PERIODIC, design=(), start=None) -> Evaluation:
    """Return an evaluation whose forces are all `force`."""
    return Evaluation(
        design={f"x{k}": float(x) for k, x in enumerate(design)},
        geometry={"area_efficiency": 0.5},
        response=dict.fromkeys(RESPONSES, force) if status.usable else {},
        gradient={},
        steady_state={},
        status=status,
        message=status.value,
        statistics={"seconds": 1.0},
        series=None,
        start=np.zeros(2) if start is None else start,
    )


class Own(Term):
    """A term from outside: `formula(profile, shape, forces)`."""

    formula: Callable = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        return self.formula(profile, shape, forces)


@contextlib.contextmanager
def registered(**formulas):
    """Register a term for each of the formulas in a `with` block."""
    with mock.patch.dict(terms._terms):
        for name, formula in formulas.items():
            register_term(name, Own(formula))
        yield


def programs() -> int:
    """Return the number of programs that the evaluators have been compiled to."""
    return sum(len(one._made) for one in (build, _motion))


@contextlib.contextmanager
def for_a_time():
    """Remove the families that are registered in a `with` block at its end.

    Compiled programs stay in memory, so that names of families must not be used again."""
    with mock.patch.dict(families._families), mock.patch.dict(families._origins):
        yield


def refusal(work, *arguments, **named) -> str:
    """Return the message with which a call rejects its arguments; it must be one line."""
    with pytest.raises(InputError) as caught:
        work(*arguments, **named)
    assert wrong_message(str(caught.value)) is None
    return str(caught.value)


class LateError(BaseException):
    """Raised if something takes too long; code that catches `Exception` does not stop it."""


@contextlib.contextmanager
def guarded(seconds: float):
    """Raise `LateError` in code that takes more CPU time than this (s)."""

    def late(*_):
        raise LateError

    before = signal.signal(signal.SIGPROF, late)
    # Raise it repeatedly, because an exception inside a destructor is lost.
    signal.setitimer(signal.ITIMER_PROF, seconds, 0.1)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def fault_of(action: Callable[[], object], seconds: float = 20.0) -> str | None:
    """Return what is wrong with an action that may end with an `InputError` and no other, or
    None."""
    try:
        with guarded(seconds):
            action()
    except InputError as error:
        return wrong_message(str(error))
    except LateError:
        return f"takes longer than {seconds} s"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]!r}"
    return None


def wrong_message(message: str) -> str | None:
    """Return what is wrong with the message of an `InputError`, or None."""
    faults = {
        "empty": not message.strip(),
        "long": len(message) > LONGEST,
        "of several lines": len(message.splitlines()) > 1,
        "not printable": not message.isprintable(),
        "a traceback": "Traceback" in message,
    }
    found = [fault for fault, is_so in faults.items() if is_so]
    return f"message is {', '.join(found)}: {message[:200]!r}" if found else None
