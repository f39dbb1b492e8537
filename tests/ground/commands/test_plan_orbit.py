"""Tests of `knightcube plan --orbit`: a three-axis slew as JSON, text and plot, and refused arguments."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import skyfield.api as skyfield

from flight.schema.bodies import as_orbit
from flight.schema.document import config_path
from flight.schema.reader import load
from tests.ground.commands.in_process import command

PLAN = ("plan", "--orbit", "orbit", "--at", "2026-03-01T12:05:00", "--nodes", "12")
TO_THE_SUN = (*PLAN, "--from", "nadir", "--to", "sun", "--earth-cone", "5")


def test_a_slew_begins_in_its_start_and_ends_in_its_target_whose_length_is_mended() -> None:
    done = command(*PLAN, "--from", "nadir", "--to", "inertial 0.1 0.2 0.3 0.9", "--within", "120", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert (facts["status"], facts["horizon_s"]) == ("optimal", 120.0)
    wanted = np.array([0.1, 0.2, 0.3, 0.9]) / np.sqrt(0.95)
    assert abs(wanted @ facts["quaternion"][-1]) == pytest.approx(1.0, abs=1e-6)
    path, rates, times = (np.array(facts[name]) for name in ("quaternion", "rate_rad_s", "time_s"))
    angle = 2.0 * np.arccos(abs(path[0] @ path[-1]))
    assert facts["turn_deg"] == pytest.approx(np.degrees(angle), rel=1e-6)
    assert facts["way_round"] == ("short" if path[0] @ path[-1] >= 0.0 else "long")
    speed = np.linalg.norm(rates, axis=1)
    assert facts["peak_rate_deg_s"] == pytest.approx(np.degrees(speed.max()))
    swept = (0.5 * (speed[1:] + speed[:-1]) * np.diff(times)).sum()
    assert facts["way_deg"] == pytest.approx(np.degrees(swept))
    assert facts["way_deg"] >= facts["turn_deg"]
    assert facts["mean_heat_W"] == pytest.approx(facts["energy_J"] / 120.0)
    # The nadir direction rotates once per orbit, in 5,677 s.
    assert np.linalg.norm(facts["rate_rad_s"][0]) == pytest.approx(2.0 * np.pi / 5677.0, rel=0.01)
    assert np.abs(facts["dipole_A_m2"]).max() == pytest.approx(
        facts["peak_of_limit"] * facts["dipole_limit_A_m2"][0]
    )


def test_a_long_slew_needs_no_longest_duration() -> None:
    done = command(*PLAN, "--from", "nadir", "--to", "sun", "--within", "7000", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["horizon_s"] == pytest.approx(7000.0)


def test_a_number_of_nodes_of_0_is_refused() -> None:
    done = command(*TO_THE_SUN, "--within", "120", "--nodes", "0")
    assert (done.returncode, "--nodes 0: must be 8 to 96" in done.stderr) == (2, True)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_target_behind_the_earth_is_named(side: float) -> None:
    """The target is the point below the satellite at the end of the slew, or the antipode of this point."""
    elements = as_orbit(load(config_path("orbit"))).elements
    assert elements is not None
    scale = skyfield.load.timescale(builtin=True)
    end = scale.from_datetime(datetime(2026, 3, 1, 12, 8, 20, tzinfo=UTC))
    below = skyfield.wgs84.subpoint_of(skyfield.EarthSatellite(*elements, ts=scale).at(end))
    longitude = below.longitude.degrees - (0.0 if side > 0.0 else 180.0)
    goal = f"ground {side * below.latitude.degrees:.3f} {longitude:.3f}"
    done = command(*PLAN, "--from", "nadir", "--to", goal, "--within", "200")
    assert done.returncode == 0, done.stderr
    assert ("the Earth hides it" in done.stdout) == (side < 0.0)
    line = next(line for line in done.stdout.splitlines() if line.startswith("target:"))
    assert side * float(line.split("satellite ")[1].split(" deg")[0]) > 80.0


def test_each_axis_has_the_dipole_limit_of_its_own_coil(tmp_path: Path) -> None:
    path = tmp_path / "unequal.yaml"
    coils = ["{axis: [1, 0, 0], dipole_per_ampere: 0.648, resistance: 23.0, channels: [0, 1]}"]
    coils += ["{axis: [0, 1, 0], dipole_per_ampere: 1.296, resistance: 23.0, channels: [2, 3]}"]
    coils += ["{axis: [0, 0, 1], dipole_per_ampere: 0.324, resistance: 23.0, channels: [4, 5]}"]
    path.write_text(f"extends: orbit\ncoils: {{windings: [{', '.join(coils)}]}}\n", encoding="utf-8")
    words = ("plan", "--orbit", path, *PLAN[3:], "--from", "nadir", "--to", "sun", "--within", "200")
    done = command(*words)
    assert done.returncode == 0, done.stderr
    assert "dipole limits: x 0.0959, y 0.1918, z 0.04795 A m^2\n" in done.stdout


def test_the_picture_is_drawn_and_the_text_says_how_far_the_camera_keeps_from_the_earth(
    tmp_path: Path,
) -> None:
    pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")
    picture = tmp_path / "slew.png"
    done = command(*TO_THE_SUN, "--within", "100", "--picture", picture)
    assert done.returncode == 0, done.stderr
    assert "to sun, roll free" in done.stdout
    (clear,) = [line for line in done.stdout.splitlines() if line.startswith("earth:")]
    assert float(clear.split()[1]) >= 0.0
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ((*PLAN, "--from", "nadir", "--to", "moon", "--within", "9"), "'moon' is not a pointing goal"),
        ((*PLAN, "--from", "nadir", "--to", "inertial 1 2 3 4", "--within", "9"), "must have length 1"),
        ((*PLAN, "--from", "nadir", "--to", "sun"), "--orbit needs --at UTC and --within S"),
        ((*TO_THE_SUN, "--within", "90", "--window", "-1"), "the window is -1 s: must be 0 to 20000"),
        ((*TO_THE_SUN, "--within", "90", "--horizon", "9"), "--horizon: cannot be used with --orbit"),
        (("plan", "--from", "0", "--to", "0", "--within", "9"), "--within: cannot be used without --orbit"),
        (("plan", "--from", "nadir", "--to", "0"), "--from: 'nadir' is not a number; targets need --orbit"),
        ((*PLAN, "--orbit", "step_demo", "--within", "9", "--from", "sun", "--to", "sun"),
         "needs the configuration of a satellite"),
    ],
)  # fmt: skip
def test_wrong_use_is_status_2(words: tuple[str, ...], complaint: str) -> None:
    done = command(*words)
    assert (done.returncode, complaint in done.stderr) == (2, True), done.stderr
