"""Tests of the star camera's availability: the fraction of unobstructed instants with attitude or rate."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import pytest

from flight.link.telemetry import definitions as table
from flight.link.telemetry.fields import Packet
from flight.link.telemetry.packets import Layout, PacketArray
from flight.schema import reader
from flight.schema.orbit import OrbitConfig, as_orbit
from ground.identification.orbit import learned_lens
from ground.report.orbit import star_camera
from ground.report.text import _lens
from ground.telemetry import Run
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.quaternion import from_rotation_vector
from tests.support.flights import CONFIG

END = 200
"""Duration (s) of the run."""
PERIOD, FINE_PERIOD, FINE_FROM = 5, 10, 100
"""Periods (s) of the configured camera, and the time (s) from which the attitude is fine."""
FAST_UNTIL, HIDDEN = 20, (50, 80)
"""Time (s) until which the body is too fast for the camera, and interval (s) with the Earth in the
exclusion cone."""


def packets(packet: Packet, times: list[float], **fields: Any) -> PacketArray:
    """Return packets at times (n,), s. Fields that are not given are zero."""
    rows = np.zeros(len(times), dtype=Layout(packet).dtype)
    rows["time_ns"] = (np.array(times) * 1e9).astype(np.int64)
    for name, values in fields.items():
        rows[name] = values
    return rows


def config() -> OrbitConfig:
    """Return a configuration whose camera looks along body +z, up to a rate of 0.02 rad/s."""
    found = as_orbit(reader.load(CONFIG.with_name("orbit.yaml")))
    assert found.camera is not None
    assert (found.camera.period, found.camera.fine_period) == (PERIOD, FINE_PERIOD)
    return reader.replace(
        found, camera=reader.replace(found.camera, mounting=(0.0, 0.0, 0.0, 1.0), max_rate=0.02)
    )


def flight(gave: list[float]) -> Run:
    """Return a run with frames at the times `gave`, which alternately have a rate and an attitude.

    The camera points to the zenith, with the Sun behind the Earth. During `HIDDEN` the camera points to the
    limb.
    """
    seconds = [float(at) for at in range(END + 1)]
    limb = math.pi - math.asin(EARTH_RADIUS / 7e6) - 0.1
    down = [HIDDEN[0] <= at < HIDDEN[1] for at in seconds]
    turns = np.array([[0.0, limb, 0.0] if turned else [0.0, 0.0, 0.0] for turned in down])
    rates = np.array([[0.0, 0.0, 0.1 if at < FAST_UNTIL else 0.001] for at in seconds])
    numbers = np.arange(len(gave))
    nan = np.full((len(gave), 4), math.nan)
    nan[1::2] = [0.0, 0.0, 0.0, 1.0]
    return cast(
        Run,
        {
            "truth": packets(table.TRUTH, seconds, quaternion=from_rotation_vector(turns), rate=rates),
            "orbit_truth": packets(
                table.ORBIT_TRUTH, seconds, position=[0.0, 0.0, 7e6], sun=[0.0, 0.0, -1.0]
            ),
            "navigation": packets(
                table.NAVIGATION, seconds, knowledge=[2 if at >= FINE_FROM else 1 for at in seconds]
            ),
            "streak": packets(
                table.STREAK,
                [at + 0.5 for at in gave],
                sequence=numbers,
                exposure_start_ns=(np.array(gave) * 1e9).astype(np.int64),
                status=[b"saturated" if number % 2 else b"rate" for number in numbers],
            ),
            "stars": packets(table.STARS, [at + 0.5 for at in gave], sequence=numbers, quaternion=nan),
        },
    )


FIRST_FINE = FINE_FROM + PERIOD
"""First instant (s) with a fine attitude, 10 s after the previous instant."""
SLOW = [*range(FAST_UNTIL, FINE_FROM, PERIOD), *range(FIRST_FINE, END - FINE_PERIOD, FINE_PERIOD)]
FREE = [at for at in SLOW if not HIDDEN[0] <= at < HIDDEN[1]]


def test_every_unobstructed_instant_counts_and_no_other() -> None:
    found = star_camera(flight([at + 0.3 for at in FREE]), config())
    assert found is not None
    assert found["instants"] == len(SLOW) + FAST_UNTIL // PERIOD
    assert found["slow"] == len(SLOW)
    assert found["unobstructed"] == found["measured"] == len(FREE)
    assert (found["share"], found["longest_gap_s"]) == (1.0, 0.0)


def test_missing_measurements_lower_the_share_and_the_longest_gap_is_stated() -> None:
    missing = [20, 25, 115, 125, 135]
    found = star_camera(flight([at + 0.3 for at in FREE if at not in missing]), config())
    assert found is not None
    assert found["share"] == pytest.approx(1.0 - len(missing) / len(FREE))
    assert found["longest_gap_s"] == 3 * FINE_PERIOD


@pytest.mark.parametrize(("rate", "period"), [(0.019, FINE_PERIOD), (0.021, PERIOD)])
def test_a_fine_attitude_lengthens_the_period_only_while_the_body_is_slow(rate: float, period: int) -> None:
    run = cast(dict[str, PacketArray], flight([21.0]))
    run["truth"]["rate"] = [0.0, 0.0, rate]
    run["navigation"]["knowledge"] = 2
    camera = config().camera
    assert camera is not None
    found = star_camera(cast(Run, run), reader.replace(config(), camera=reader.replace(camera, max_rate=0.1)))
    assert found is not None
    assert found["instants"] == END // period


def test_the_sun_in_its_cone_leaves_no_unobstructed_instant() -> None:
    run = cast(dict[str, PacketArray], flight([21.0]))
    run["orbit_truth"]["sun"] = [0.0, 0.5, math.sqrt(0.75)]
    found = star_camera(cast(Run, run), config())
    assert found is not None
    assert found["unobstructed"] == 0
    assert math.isnan(found["share"])


def test_without_a_truth_log_nothing_is_said() -> None:
    run = cast(dict[str, PacketArray], flight([21.0]))
    run["truth"] = run["truth"][:0]
    assert star_camera(cast(Run, run), config()) is None


def test_the_learned_lens_is_that_of_the_last_packet() -> None:
    sigma = [[0.5, 0.4, 0.3, 2e-3, 6e-2, 2e-7, 0.02], [0.1, 0.2, 0.2, 1e-3, 3e-2, 1e-7, 0.01]]
    rows = packets(table.LENS, [1.0, 6.0], frames=[1, 2], focal_length=[900.0, 901.0], sigma=sigma)
    rows["corner_sigma"][1] = 4e-4
    run = cast(Run, {"lens": rows})
    found = learned_lens(run)
    assert found is not None
    assert (found["frames"], found["focal_length_px"]) == (2, [901.0, 0.1])
    text = "\n".join(_lens(found))
    assert "focal length 901.00 +- 0.10 px" in text
    assert "distance of a corner from the centre +- 0.0400 %" in text
    assert "line time 0.00 +- 0.10 us" in text
    assert learned_lens(cast(Run, {"lens": rows[:0]})) is None
