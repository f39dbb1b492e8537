"""The random streams of one seed, so that another simulator can build the same craft."""

from __future__ import annotations

import numpy as np

_STREAM = 0xF4EE


def generators(seed: int) -> tuple[np.random.Generator, np.random.Generator, np.random.Generator]:
    """Return the generators of the craft's errors, of the release, and of air, storms and walks."""
    errors, tip_off, weather = (np.random.default_rng([seed, _STREAM, stream]) for stream in range(3))
    return errors, tip_off, weather
