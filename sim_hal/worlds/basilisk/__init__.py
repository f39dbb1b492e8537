"""A world that is not ours: Basilisk (AVS Lab, PyPI `bsk`, extra `worlds`) behind the World Protocol."""
