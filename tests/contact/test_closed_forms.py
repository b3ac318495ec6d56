"""Tests of small parts of the contact, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.polygons import signed_distance
from rootsopt.contact.search import SearchContact
from rootsopt.profiles import CIC, five_arcs


def test_levers_may_jump_where_flanks_do_not_roll():
    """A CIC pair has one closest approach at the nominal centre distance.

    At any other distance there may be two of equal depth, as beside the joints of other flanks."""
    paper = CIC(3, 0.033, np.radians(36.43), 8e-3, np.radians(4.0))
    assert not SearchContact.of(paper).jumps
    displaced = SearchContact.of(paper, jnp.asarray(0.0662), two_sided=True)
    assert displaced.jumps
    assert SearchContact.of(five_arcs(3, 0.033, 0.045, 0.05, 0.013, 1.0)).jumps
    assert float(displaced.pair.center_distance) == 0.0662


def test_distance_from_a_circle_of_few_nodes():
    """The distance is positive outside.

    Distances to chords are too great by up to R (1 - cos π/n) outside; those to cubics have an
    error of fourth order."""
    rng = np.random.default_rng(0)
    radii, angles = rng.uniform(0.5, 1.5, 300), rng.uniform(0, 2 * np.pi, 300)
    nodes = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    errors = []
    for count in (32, 64):
        turns = 2 * np.pi * np.arange(count + 1) / count
        circle = np.column_stack([np.cos(turns), np.sin(turns)])
        straight, cubic = (signed_distance(nodes, circle, refine) for refine in (False, True))
        sagitta = 1 - np.cos(np.pi / count)
        far = straight - (radii - 1)
        assert -1e-12 < np.min(far) < 0.1 * sagitta
        assert 0.9 * sagitta < np.max(far) < 1.001 * sagitta
        errors.append(np.max(np.abs(cubic - (radii - 1))))
        assert errors[-1] < 0.02 * sagitta
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.2)
