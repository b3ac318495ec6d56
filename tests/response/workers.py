"""Points and designs that need no simulation, for tests of processes: use it with `--import`.

A point takes `TEST_SECONDS` and is then invalid. At a speed of `DEADLY` its process is killed."""

import os
import signal
import time

from rootsopt import InputError
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.sweeps import points

DEADLY = 666.0


def work(config):
    """Take time, or kill this process."""
    time.sleep(float(os.environ["TEST_SECONDS"]))
    if config.scene.speed_rpm == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)


def check(config):
    """Stand in for the check of a geometry, which comes before anything is compiled."""
    work(config)
    raise InputError(f"at {config.scene.speed_rpm:g}")


def evaluation(self, design=None, start=None, series=True):
    """Stand in for an evaluation, of which nothing is read."""
    work(self.config)


if os.environ.get("TEST_SECONDS"):
    points.check_geometry = check
    Evaluator.__call__ = evaluation
