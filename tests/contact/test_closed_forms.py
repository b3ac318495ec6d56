"""Tests of small parts of the contact, against closed forms."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rootsopt.contact.search import SearchContact
from rootsopt.profiles import CIC, five_arcs


def test_levers_may_jump_where_flanks_do_not_roll():
    """A CIC pair has one closest approach at the nominal centre distance.

    At any other distance there may be two of equal depth, as beside the joints of other flanks."""
    paper = CIC(3, 0.033, np.radians(36.43), 8e-3, np.radians(4.0))
    contact_of = eqx.filter_jit(SearchContact.of)
    assert not contact_of(paper).jumps
    displaced = contact_of(paper, jnp.asarray(0.0662), two_sided=True)
    assert displaced.jumps
    arcs = eqx.filter_jit(five_arcs)(3, *map(jnp.asarray, (0.033, 0.045, 0.05, 0.013, 1.0)))
    assert contact_of(arcs).jumps
    assert float(displaced.pair.center_distance) == 0.0662
