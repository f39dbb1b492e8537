"""Flights that several tests share. Each flight is simulated once."""

from __future__ import annotations

import base64
import pickle
from pathlib import Path

import numpy as np
import pytest

from ground.identification.fit import PlantFit, fit, noise_of
from ground.identification.record import Record
from tests.ground.identification.worlds import World, believed, drawn, fly_bare
from tests.support.shared_results import made_once

Identified = tuple[World, Record, PlantFit]


def _identified() -> str:
    """Return four random worlds, their simulated records and their fits, encoded as a string.

    The records come from simulations of the testbed without the flight software.
    """
    rng = np.random.default_rng(20)
    worlds = [drawn(rng) for _ in range(4)]
    records = [fly_bare(world, 85.0) for world in worlds]
    noise = noise_of(believed())
    made = [(world, record, fit(record, noise)) for world, record in zip(worlds, records, strict=True)]
    return base64.b64encode(pickle.dumps(made)).decode()


@pytest.fixture(scope="session")
def identified(session_folder: Path) -> list[Identified]:
    """Return four random worlds with their flights and fits, computed by only one process of the session."""
    found: list[Identified] = pickle.loads(
        base64.b64decode(made_once(session_folder, "identified", _identified))
    )
    return found
