"""Points that need no simulation, for tests of processes: import this file with `--import`.

A point takes `TEST_SECONDS` and is then invalid. At a speed of `DEADLY` its process is killed."""

import os
import signal
import time

from rootsopt.errors import InputError
from rootsopt.sweeps import points

DEADLY = 666.0


def check(config):
    """Stand in for the check of a geometry, which comes before anything is compiled."""
    time.sleep(float(os.environ.get("TEST_SECONDS", "0.1")))
    if config.scene.speed_rpm == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    raise InputError(f"at {config.scene.speed_rpm:g}")


if os.environ.get("TEST_SECONDS"):
    points.check_geometry = check
