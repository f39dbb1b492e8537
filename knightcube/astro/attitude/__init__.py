"""Attitude from directions: Wahba's problem and its solvers."""
