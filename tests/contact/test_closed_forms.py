"""Tests of small parts of the contact, against closed forms."""

import jax.numpy as jnp
import numpy as np

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
