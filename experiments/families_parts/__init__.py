"""Parts of `experiments/families.py`."""
