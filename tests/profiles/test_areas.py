"""Area and polar moment of every family are those of polygons of its own outline.

The polygons use positions alone."""

import numpy as np
import pytest

from experiments.geometry import study
from rootsopt.config import FAMILY_KEYS

ERROR = 1e-11
"""Relative error allowed; the study in experiments/geometry finds 1e-13."""
HARD = {
    # The normals of the arc all but touch the pitch circle, at its end or inside of it.
    "cic": (5, [[36.43, 6.0, 4.0], [9.90309962, 4.61058857e-06, 0.00440706401]]),
    "ee": (4, [[]]),
    "arc": (5, [[30.0], [31.9750552], [32.99]]),
    "arcs_epicycloid": (5, [[32.2328279, 4.52872269, 1.31231773]]),
    "arc_involute": (5, [[30.0, 4.0], [9.57156265, 2.03155703e-06], [86.07009, 4.82898416]]),
    "four_arcs": (5, [[32.7457584, 9.9455844, 26.4908313]]),
    "five_arcs": (5, [[38.6977037, 3.82052582, 10.6338733, 36.9061107]]),
    "circle_epicycloid": (5, [[10.5861275, 89.9968733]]),
    "hypo_epicycloid": (5, [[3.0], [17.9924375]]),
    # The pressure angle is steep.
    "extended_cycloid": (5, [[1.0], [0.3835], [0.238601779]]),
    "ellipse": (5, [[9.46007216, 27.8267607]]),
    "free_form": (3, [[4.0, 0.8, 0.7, 0.75], [5.04175591, 0.98336944, 0.83837998, -0.4203177]]),
}
"""Number of lobes and designs (config units) of each family."""


@pytest.mark.parametrize("family", HARD)
def test_area_and_moment_are_those_of_the_outline(family):
    lobes, designs = HARD[family]
    designs = np.array(designs).reshape(len(designs), -1)
    area, moment, reference = np.asarray(study.compared(family, lobes, designs)).T
    assert np.max(reference) < ERROR / 10
    assert np.max(area) < ERROR
    assert np.max(moment) < ERROR


def test_every_family_is_looked_at():
    assert set(HARD) == {*FAMILY_KEYS} - {"outline"}
