"""Tests of `knightcube bringup`: stored steps, resumption, and the corrected configuration."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flight.schema.reader import load
from ground.bringup.bench import Outcome, Session
from ground.bringup.session import STEPS
from hal.drivers.coils import PwmTorqueCoils
from tests.ground.commands.in_process import command

WIRED = """\
extends: step_demo
inertial_unit:
  mounting: [0.0, 0.0, 0.70710678, 0.70710678]
power_monitor: {shunt: 0.02}
coils:
  windings:
    - {axis: [1.0, 0.0, 0.0], resistance: 23.0, channels: [2, 3], sign: -1}
    - {axis: [0.0, 1.0, 0.0], resistance: 23.0, channels: [0, 1]}
    - {axis: [0.0, 0.0, 1.0], resistance: 23.0, channels: [4, 5]}
simulation:
  truth: {resistance: [23.0, 23.0, 34.5]}
"""
ONLY = [word for step in ("axes", "coils") for word in ("--only", step)]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a session with four faults. The results are in its subfolder `bench`."""
    folder = tmp_path_factory.mktemp("bringup")
    (folder / "wired.yaml").write_text(WIRED, encoding="utf-8")
    done = command("bringup", "step_demo", "--wired", folder / "wired.yaml", "--out", folder / "bench", *ONLY)
    assert done.returncode == 1, done.stderr
    for part in ("rotated", "windings[0]: exchanged", "windings[1]: exchanged", "wrong resistance", "shunt"):
        assert part in done.stdout
    return folder


def test_the_fragment_cures_the_faults(bench: Path) -> None:
    fragment = bench / "bench" / "measured.yaml"
    done = command("bringup", fragment, "--wired", bench / "wired.yaml", "--out", bench / "again", *ONLY)
    assert done.returncode == 0, done.stdout
    found = load(fragment)
    assert [one.sign for one in found.coils.windings] == [-1, 1, 1]
    assert found.coils.windings[2].resistance == pytest.approx(34.5, rel=0.03)
    assert found.power_monitor is not None
    assert found.power_monitor.shunt == pytest.approx(0.02, rel=0.03)
    assert np.array(found.inertial_unit.mounting) == pytest.approx(
        np.array([0.0, 0.0, 0.5**0.5, 0.5**0.5]), abs=1e-6
    )


def test_a_repeated_session_does_only_the_missing_steps(bench: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def noted(name: str) -> None:
        step = STEPS[name]

        def run(session: Session) -> Outcome:
            done.append(name)
            return step(session) if name == "find" else Outcome(values={"skipped": "not tried"})

        monkeypatch.setitem(STEPS, name, run)

    for name in list(STEPS):
        noted(name)
    words: list[str | Path] = [
        "bringup",
        "step_demo",
        "--wired",
        bench / "wired.yaml",
        "--out",
        bench / "bench",
        "--json",
    ]
    first = json.loads(command(*words).stdout)
    assert done == ["find", "rest", "dark", "light", "focus", "lens"]
    assert first["steps"]["coils"]["findings"], "the findings of the kept steps are reported again"
    done.clear()
    command(*words)
    assert done == ["rest", "dark", "light", "focus", "lens"], "a skipped step is tried again"


def test_ctrl_c_keeps_the_finished_steps_and_ends_with_the_coils_at_zero(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven: list[PwmTorqueCoils] = []
    plain = PwmTorqueCoils.command

    def interrupted(coils: PwmTorqueCoils, currents: np.ndarray) -> None:
        plain(coils, currents)
        if currents.any():
            driven.append(coils)
            assert coils.state().current.any()
            raise KeyboardInterrupt

    monkeypatch.setattr(PwmTorqueCoils, "command", interrupted)
    done = command("bringup", "step_demo", "--out", tmp_path / "bench", "--only", "find", "--only", "coils")
    assert done.returncode == 130
    assert len(driven) == 1
    assert not driven[0].state().current.any()
    assert list(json.loads((tmp_path / "bench" / "report.json").read_text())["steps"]) == ["find"]


def test_a_board_without_devices_names_each_missing_device(tmp_path: Path) -> None:
    done = command("bringup", "board_testbed", "--yes", "--only", "find", "--out", tmp_path / "bench")
    assert done.returncode == 1
    for part in ("inertial_unit", "coils", "power_monitor", "camera"):
        assert f"{part}: no answer" in done.stdout
