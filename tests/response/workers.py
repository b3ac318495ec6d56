"""Points and designs that need no simulation, for tests of processes: use it with `--import`.

A point takes `TEST_SECONDS` and is then invalid. At a speed of `DEADLY` its process is killed. The
mean force of a design is `force` of its parameters."""

import os
import signal
import time

import numpy as np

from rootsopt.errors import InputError
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.sweeps import points
from rootsopt.status import Status

DEADLY = 666.0


def check(config):
    """Stand in for the check of a geometry, which comes before anything is compiled."""
    time.sleep(float(os.environ.get("TEST_SECONDS", "0.1")))
    if config.scene.speed_rpm == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    raise InputError(f"at {config.scene.speed_rpm:g}")


def force(design):
    """Return the mean force of a design."""
    return float(np.sum(np.asarray(design) / 3))


def evaluation(self, design=None, start=None, series=True):
    """Stand in for an evaluation."""
    del start, series
    time.sleep(float(os.environ.get("TEST_SECONDS", "0.1")))
    if self.config.scene.speed_rpm == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    named = dict(zip(self.keys, map(float, design), strict=True))
    return Evaluation(named, {}, {"mean_force_N": force(design)}, {}, {}, Status.PERIODIC, "", {},
                      None, np.asarray(design))  # fmt: skip


if os.environ.get("TEST_SECONDS"):
    points.check_geometry = check
    Evaluator.__call__ = evaluation
