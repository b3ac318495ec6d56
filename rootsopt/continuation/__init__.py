"""Continuation: families of periodic orbits, followed along a parameter."""

from rootsopt.continuation.branch import Bifurcation as Bifurcation
from rootsopt.continuation.branch import Branch as Branch
from rootsopt.continuation.branch import Kind as Kind
from rootsopt.continuation.branch import follow as follow
from rootsopt.continuation.branch import follow_doubled as follow_doubled
