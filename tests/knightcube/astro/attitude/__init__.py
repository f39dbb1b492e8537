"""Tests of the solvers of Wahba's problem."""
