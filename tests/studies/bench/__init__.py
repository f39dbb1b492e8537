"""Benchmarks: `python -m tests.studies.bench`."""
