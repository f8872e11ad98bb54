"""Parts of recipes/benchmarks/speed.py: workloads, baselines, measurements and the table."""
