"""Studies that measure performance: campaigns, benchmarks, mutation tests, and plots."""
