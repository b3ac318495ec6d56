"""Families of periodic orbits, followed along a parameter: the public names."""

from rootsopt.response.continuation.arclength import End, StepSizes
from rootsopt.response.continuation.branch import Bifurcation, Branch, Kind, follow, follow_doubled

__all__ = ["Bifurcation", "Branch", "End", "Kind", "StepSizes", "follow", "follow_doubled"]
