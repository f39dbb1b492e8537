"""Attitude determination from measured directions: Wahba's problem and its solvers."""
