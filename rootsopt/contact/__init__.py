"""Contact of two flanks: where they touch, and with what force."""

from rootsopt.contact.closest import FlankPair
from rootsopt.contact.gap import ClosestApproach, Contact
from rootsopt.contact.law import ContactLaw, ImpactLaw, ramp, smooth_step

__all__ = [
    "ClosestApproach",
    "Contact",
    "ContactLaw",
    "FlankPair",
    "ImpactLaw",
    "ramp",
    "smooth_step",
]
