"""Flights that several tests look at, flown once."""

from __future__ import annotations

import numpy as np
import pytest

from ground.identification.fit import PlantFit, fit
from ground.identification.record import Record
from ground.identification.scale import noise_of
from tests.ground.identification.worlds import World, believed, drawn, fly_bare

Identified = tuple[World, Record, PlantFit]


@pytest.fixture(scope="session")
def identified() -> list[Identified]:
    """Four drawn worlds, flown on the bare testbed and fitted."""
    rng = np.random.default_rng(20)
    worlds = [drawn(rng) for _ in range(4)]
    records = [fly_bare(world, 85.0) for world in worlds]
    noise = noise_of(believed())
    return [(world, record, fit(record, noise)) for world, record in zip(worlds, records, strict=True)]
