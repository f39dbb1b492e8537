"""Tests that coarse pointing tables and short runs equal their recorded results to five digits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import pressures
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.gnc.control.pointing_law import PointingLaw, damping_dipole
from knightcube.gnc.control.pointing_table import (
    PointingPreview,
    PointingTable,
    PointingWeights,
    pointing_table,
)
from knightcube.gnc.guidance.attitude_law import approach, references
from tests.knightcube.gnc.control.pointing_cases import (
    INERTIA,
    LAW,
    LIMIT,
    ORBIT,
    RESIDUAL,
    SIZE,
    STEP,
    WEIGHTS,
)
from tests.support.recorded_flights import unlike_record
from tests.support.recorded_results import check

TIMES: FloatArray = np.arange(STEP, 61.0 * STEP, STEP)
KEPT = 20


def table(
    turn: tuple[float, float, float], weights: PointingWeights = WEIGHTS, limit: float = LIMIT
) -> PointingTable:
    """Return the table of a path from an attitude that differs from the law by a rotation vector (rad)."""
    wanted = references(LAW, ORBIT, TIMES)
    begin = multiply(from_rotation_vector(np.array(turn)), wanted.quaternion[0])
    way = approach(LAW, begin, np.array([1e-4, -2e-4, 1e-4]), STEP, 12.0 * STEP)
    first = references(way, ORBIT, TIMES[: KEPT + 1])
    around = ORBIT.field_at(TIMES), ORBIT.position_at(TIMES), pressures(ORBIT, TIMES)
    return pointing_table(PointingPreview(wanted, first, *around, SIZE), INERTIA, limit, weights)


def test_a_table_near_the_law_is_as_recorded() -> None:
    check(__file__, "near", table((0.01, -0.02, 0.03)), 1e-4)


def test_a_table_far_off_the_law_is_as_recorded() -> None:
    check(__file__, "far", table((0.4, 0.3, -0.6)), 1e-4)


def test_a_table_at_the_limit_of_the_coils_is_as_recorded() -> None:
    check(__file__, "limited", table((0.2, -0.3, 0.1), limit=0.02), 1e-4)


def test_a_table_with_a_largest_rate_is_as_recorded() -> None:
    check(__file__, "slow", table((0.3, 0.3, 0.3), replace(WEIGHTS, fastest=2e-3)), 1e-4)


def test_the_commands_of_the_pointing_law_are_as_recorded() -> None:
    law, found = PointingLaw(table((0.01, -0.02, 0.03)), LIMIT), []
    for number, time in enumerate(TIMES[:KEPT:3].tolist()):
        wanted = law.wanted(time)
        off = from_rotation_vector(0.01 * np.array([np.sin(number), np.cos(number), 0.3]))
        field = ORBIT.field_at(np.array([time]))[0]
        found.append(
            law.command(time, multiply(off, wanted.quaternion), 1e-3 * np.ones(3), field, RESIDUAL, SIZE)
        )
    check(__file__, "commands", found, 1e-4)


def test_the_dipole_that_damps_a_rotation_is_as_recorded() -> None:
    rng = np.random.default_rng(3)
    draws = [(1e-2 * rng.normal(size=3), 3e-5 * rng.normal(size=3)) for _ in range(5)]
    check(__file__, "damping", [damping_dipole(INERTIA, rate, field) for rate, field in draws])


def test_a_steered_flight_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("steps", tmp_path) == []


def test_a_flight_with_the_tracker_of_the_thesis_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("thesis", tmp_path) == []


def test_a_flight_in_the_cage_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("cage", tmp_path) == []


def test_a_detumbling_flight_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("detumbling", tmp_path) == []
