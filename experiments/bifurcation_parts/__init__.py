"""Parts of `experiments/bifurcation.py`: orbits that are looked for, and the figures."""
