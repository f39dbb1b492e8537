"""Simulated world (body and environment) of the simulator Basilisk (AVS Lab, PyPI `bsk`, extra `worlds`)."""

STEP_NS = 25_000_000
"""Integration step (ns) of Basilisk."""
