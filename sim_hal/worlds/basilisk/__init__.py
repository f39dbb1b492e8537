"""The simulator Basilisk (AVS Lab, PyPI `bsk`, extra `worlds`) as a world."""

STEP_NS = 25_000_000
"""Integration step (ns) of Basilisk."""
