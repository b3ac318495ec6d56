"""Contact of two flanks: where they touch, and with what force."""

from rootsopt.contact.closest import ClosestApproach, FlankPair
from rootsopt.contact.impact import ImpactLaw, ramp, smooth_step

__all__ = ["ClosestApproach", "FlankPair", "ImpactLaw", "ramp", "smooth_step"]
