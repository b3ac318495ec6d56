"""Contact of two flanks: where they touch, and with what force."""

from rootsopt.contact.closest import ClosestApproach, FlankPair
from rootsopt.contact.gap import Contact
from rootsopt.contact.impact import ImpactLaw, ramp, smooth_step
from rootsopt.contact.law import ContactLaw

__all__ = [
    "ClosestApproach",
    "Contact",
    "ContactLaw",
    "FlankPair",
    "ImpactLaw",
    "ramp",
    "smooth_step",
]
