"""Continuation: families of periodic orbits, followed along a parameter."""

from rootsopt.continuation.arclength import End, StepSizes
from rootsopt.continuation.branch import Bifurcation, Branch, Kind, follow, follow_doubled

__all__ = ["Bifurcation", "Branch", "End", "Kind", "StepSizes", "follow", "follow_doubled"]
