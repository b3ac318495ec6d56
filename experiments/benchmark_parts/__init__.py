"""Parts of `experiments/benchmark.py`: what each measures, and the report."""
