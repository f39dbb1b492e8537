"""Tests that the text, JSON and messages of `knightcube orbit` agree, and that a short arc is refused."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.link.telemetry.packets import LAYOUTS
from ground.commands import runs as command
from ground.messages import orbits_of
from knightcube.errors import UsageError
from tests.support import short_arcs as passes

UTC_NS = 1_774_008_000_000_000_000


class Tracked(dict[str, Any]):
    """Test double of a run with the fields that `orbits_of` reads."""

    folder = Path("runs/tracked")


def tracked(seconds: float) -> tuple[Tracked, np.ndarray]:
    """Return packets of the pass of an object at a distance of 2,000 km, and its true state at mid-pass."""
    rng = np.random.default_rng(4)
    times = np.arange(0.0, seconds + 0.5, 10.0)
    middle = len(times) // 2
    own = np.array([6.878e6, 0.0, 0.0, 0.0, 4.0e3, 6.48e3])
    other = np.array([6.6e6, 1.9e6, 5e5, -914.0, 1.2e3, 7.5e3])
    observer, true = (passes.flown_states(state, times, middle) for state in (own, other))
    way = true[:, :3] - observer[:, :3]
    # An almanac gives 29.9 km/s for the speed of the Earth at the epoch, near the equinox.
    earth = np.array([0.0, -29.9e3 * np.cos(np.radians(23.44)), -29.9e3 * np.sin(np.radians(23.44))])
    late = np.linalg.norm(way, axis=1, keepdims=True) / passes.LIGHT
    seen = way - late * (true[:, 3:] + earth)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    seen += 5e-6 * rng.normal(size=seen.shape)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    track = np.zeros(len(times), dtype=LAYOUTS["track"].array(b"").dtype)
    track["number"], track["middle_ns"] = 3, np.round(times * 1e9)
    track["measured"], track["measured_sigma"] = seen, 5e-6
    track["place"] = observer[:, :3] + 3.0 * rng.normal(size=(len(times), 3))
    track["velocity"], track["place_sigma"] = observer[:, 3:], 3.0
    label = np.zeros(1, dtype=LAYOUTS["run"].array(b"").dtype)
    label["utc_ns"] = UTC_NS
    return Tracked(track=track, run=label), true[middle]


def orbit_status(run: Tracked, words: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(command, "read_run", lambda _: run)
    parser = argparse.ArgumentParser()
    command.configure_orbit(parser)
    return command.run_orbit(parser.parse_args(["runs/tracked", *words]))


def test_the_orbit_is_the_true_one_in_each_form(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, true = tracked(240.0)
    assert orbit_status(run, ["--json", "--opm", str(tmp_path)], monkeypatch) == 0
    (facts,) = json.loads(capsys.readouterr().out)["objects"]
    found = np.array(facts["orbit"]["position_m"] + facts["orbit"]["velocity_m_s"])
    covariance = np.array(facts["orbit"]["covariance"])
    off = found - true
    # 99.9 % quantile of the chi-square distribution with six degrees of freedom.
    assert off @ np.linalg.solve(covariance, off) < 22.5
    assert np.linalg.norm(off[:3]) < 50e3
    assert facts["orbit"]["utc"].startswith("2026-03-20T12:02:00")
    rows = dict(
        row.split(" = ") for row in (tmp_path / "object-3.opm").read_text().splitlines() if " = " in row
    )
    assert (rows["CENTER_NAME"], rows["REF_FRAME"], rows["TIME_SYSTEM"]) == ("EARTH", "ICRF", "UTC")
    assert rows["EPOCH"] == "2026-03-20T12:02:00.000000"
    axes = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
    written = [1e3 * float(rows[axis].split()[0]) for axis in axes]
    np.testing.assert_allclose(written, found, rtol=0.0, atol=1e-3)
    assert 1e6 * float(rows["CZ_DOT_X"].split()[0]) == pytest.approx(covariance[5, 0], rel=1e-6)
    assert rows["CZ_DOT_X"].endswith("[km**2/s]")


def test_a_short_arc_is_reported_as_such(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run, _ = tracked(60.0)
    run["track"]["measured_sigma"] = 1e-4
    assert orbit_status(run, ["--opm", str(tmp_path / "none")], monkeypatch) == 1
    assert "no orbit: the arc of 60 s is too short" in capsys.readouterr().out
    assert not (tmp_path / "none").exists()


def test_a_run_without_positions_or_objects_is_refused_with_the_reason() -> None:
    run, _ = tracked(240.0)
    run["track"]["place"] = np.nan
    (found,) = orbits_of(run)  # type: ignore[arg-type]
    assert found.orbit is None
    assert found.reason.startswith("0 sightings with the satellite's position")
    empty = Tracked(track=run["track"][:0], run=run["run"])
    with pytest.raises(UsageError, match="no object was tracked"):
        orbits_of(empty)  # type: ignore[arg-type]
