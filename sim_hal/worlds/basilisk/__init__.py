"""A world that is not ours: Basilisk (AVS Lab, PyPI `bsk`, extra `worlds`) behind the World Protocol."""

STEP_NS = 25_000_000
"""Of Basilisk's integration."""
