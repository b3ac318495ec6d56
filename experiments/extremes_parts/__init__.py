"""Parts of `experiments/extremes.py`: the scenes, what is asked of each, and the figure."""
