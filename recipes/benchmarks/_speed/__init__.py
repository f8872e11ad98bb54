"""What recipes/benchmarks/speed.py is made of: workloads, baselines, measuring and the table."""
