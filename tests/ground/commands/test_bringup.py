"""Tests of `knightcube bringup`: stored steps, resumption, and the corrected configuration."""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flight.schema import reader
from flight.schema.reader import load
from ground.bringup.bench import Outcome, Session, StepSkipped
from ground.bringup.diagnosis import Finding
from ground.bringup.session import STEPS, steps_of
from ground.commands import bringup
from hal.drivers.coils import PwmTorqueCoils
from hal.interfaces.wires import Rig
from knightcube.errors import UsageError
from tests.ground.commands.in_process import command
from tests.support.orbit_devices import orbit_config
from tests.support.places import DEMO

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


# Tests of the command with scripted steps.

FAULT = Finding("coils", "no field", "nothing", "look", 2.0)
VALUES: dict[str, Any] = {
    "rest": {
        "rate_hz": 39.987,
        "noise": {
            "gyro": [1e-4, 3e-4, 2e-4],
            "field": [1e-8, 2e-8, 3.14e-8],
            "acceleration": [0.1, 0.2, 0.05],
        },
        "expected": {"gyro": 2.7e-4, "field": 6.3e-8, "acceleration": 0.012},
    },
    "axes": {"turns_deg": [[88.0, 0.0, 0.0], [0.0, 91.4, 0.0], [3.0, 4.0, 92.0]]},
    "coils": {"strength": [1.004, -0.97, 0.0], "current": [[0.1, 0.12], [None, None], [0.0, 0.05]]},
    "power": {
        "monitors": {
            "battery": {"voltage": 7.456, "current": 0.1234, "rise": 0.15},
            "bus": {"voltage": 5.0, "current": 0.2, "rise": -0.01},
        }
    },
    "gps": {"fixes": 12, "satellites": 9, "offset_s": 0.1},
    "strings": {"currents": [[0.4, 0.001], [0.002, 0.25]]},
    "wide": {"levels": {"a": 120.4, "b": 60.6}},
    "dark": {"level": 100.4, "read_noise": 8.26, "noise_counts": 4.0},
    "light": {"sources": 17, "level": 101.0},
    "focus": {"psf_sigma": 1.234},
    "lens": {"field_of_view_deg": 20.1239, "stars": 55, "rms_px": 0.0512},
}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rest", "39.99 samples/s; noise (expected) 0.0003 (0.00027) rad/s, 31 (63) nT, 0.2 (0.012) m/s^2"),
        ("axes", "rotations of 90 deg, measured by the gyro: x 88, y 91, z 92 deg"),
        ("coils", "fields relative to the expected ones +1.00, -0.97, +0.00; supply current 110, -, 25 mA"),
        ("power", "battery 7.46 V, 0.123 A, with a coil +150 mA, bus 5.00 V, 0.200 A, with a coil -10 mA"),
        ("gps", "12 fixes, 9 satellites"),
        ("strings", "currents in the light of a lamp 400, 250 mA"),
        ("wide", "mean levels 120, 61 counts"),
        ("dark", "level 100 counts, read noise 8.3 e-"),
        ("light", "17 point sources, level 101 counts"),
        ("focus", "PSF width 1.23 px (standard deviation)"),
        ("lens", "field of view 20.124 deg, 55 stars, residual 0.051 px"),
    ],
)
def test_each_step_shows_its_measured_values_on_one_line(name: str, text: str) -> None:
    assert bringup._step_text(name, Outcome(values=VALUES[name])) == f"{name:8}ok    {text}\n"
    faulty = bringup._step_text(name, Outcome([FAULT], VALUES[name]))
    assert faulty == f"{name:8}FAULT {text}\n        coils: no field: nothing: look\n"


def test_other_lines_of_a_step_name_devices_few_samples_and_the_reason_of_a_skipped_step() -> None:
    found = Outcome([FAULT], {"answers": {"gps": "/dev/gps: opens", "coils": "0x40: no answer"}})
    assert bringup._step_text("find", found).splitlines() == [
        "find    ok    gps on /dev/gps: opens",
        "find    FAULT coils on 0x40: no answer",
        "        coils: no field: nothing: look",
    ]
    assert bringup._step_text("rest", Outcome(values={"samples": 3})) == "rest    ok    3 samples\n"
    assert bringup._step_text("gps", Outcome(values={"skipped": "no"})) == "gps     skipped: no\n"


class Scripted:
    """Scripted steps with given outcomes, in a session without devices."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, folder: Path, **outcomes: Outcome | StepSkipped
    ) -> None:
        self.done: list[str] = []
        self.lost: list[Finding] = []
        self.known: dict[str, list[str]] = {}
        self.pictures: list[tuple[Any, ...]] = []
        self.folder = folder
        for name in STEPS:
            monkeypatch.setitem(
                STEPS, name, self.step(name, outcomes.get(name, Outcome(values=VALUES.get(name, {}))))
            )
        drawing = SimpleNamespace(draw_bench=lambda *words: self.pictures.append(words))
        monkeypatch.setitem(sys.modules, "ground.report.figures", drawing)
        monkeypatch.setattr(bringup, "_opened", self.opened)

    @contextmanager
    def opened(self, *words: Any) -> Iterator[Any]:
        yield SimpleNamespace(known={}, lost_guardians=lambda: self.lost)

    def step(self, name: str, outcome: Outcome | StepSkipped) -> Callable[[Any], Outcome]:
        def run(session: Any) -> Outcome:
            self.done.append(name)
            self.known[name] = list(session.known)
            if isinstance(outcome, StepSkipped):
                raise outcome
            return outcome

        return run

    def run(self, *words: str) -> int:
        parser = argparse.ArgumentParser()
        bringup.configure(parser)
        given = parser.parse_args(["step_demo", "--out", str(self.folder / "bench"), *words])
        return int(bringup.run(given))

    def report(self) -> dict[str, Any]:
        stored: dict[str, Any] = json.loads((self.folder / "bench" / "report.json").read_text())
        return stored


ANSWERS = Outcome(values={"answers": {"gps": "opens"}})


def test_the_results_of_all_steps_are_kept_and_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    dark = Outcome([], VALUES["dark"], {"camera": {"read_noise": 8.3}}, {"a": np.arange(3)},
                   {"dark": np.full((20, 30), 7, np.uint16)})  # fmt: skip
    focus = Outcome([], VALUES["focus"], {"camera": {"psf_sigma": 1.2}, "coils": {"stale_after": 0.4}})
    scripted = Scripted(monkeypatch, tmp_path, find=ANSWERS, dark=dark, focus=focus)
    assert scripted.run() == 0
    names = ["find", "rest", "axes", "coils", "dark", "light", "focus", "lens"]
    assert scripted.done == names
    assert scripted.known["axes"] == ["find", "rest"]
    bench = tmp_path / "bench"
    steps = scripted.report()["steps"]
    assert list(steps) == names
    assert steps["dark"]["values"] == VALUES["dark"]
    assert steps["dark"]["changes"] == {"camera": {"read_noise": 8.3}}
    assert len({one["config"] for one in steps.values()}) == 1
    assert len(steps["dark"]["config"]) == 16
    fragment = load(bench / "measured.yaml")
    assert (fragment.camera.read_noise, fragment.camera.psf_sigma) == (8.3, 1.2)  # type: ignore[union-attr]
    assert fragment.coils.stale_after == 0.4
    assert (bench / "measured.yaml").read_text().startswith("# Measured by `knightcube bringup ")
    with np.load(bench / "dark.npz") as kept:
        assert kept["a"].tolist() == [0, 1, 2]
    ((path, ordered, frames),) = scripted.pictures
    assert path == bench / "bringup.png"
    assert list(ordered) == names
    assert frames == {"dark": bench / "dark.png"}
    shown = capsys.readouterr().out
    assert shown.endswith(f"verdict 0 faults; {bench / 'measured.yaml'}, {bench / 'bringup.png'}\n")
    assert "dark    ok    level 100 counts, read noise 8.3 e-\n" in shown

    scripted.done.clear()
    assert scripted.run("--json") == 0
    assert scripted.done == []
    facts = json.loads(capsys.readouterr().out)
    assert (list(facts["steps"]), facts["faults"]) == (names, 0)
    assert scripted.pictures[1][1]["dark"].arrays["a"].tolist() == [0, 1, 2]
    assert scripted.run("--only", "axes", "--only", "rest") == 0
    assert scripted.done == ["axes", "rest"]
    assert set(scripted.report()["steps"]) == set(names)
    scripted.done.clear()
    assert scripted.run("--again") == 0
    assert scripted.done == names


@pytest.mark.parametrize(
    ("outcome", "status", "verdict"),
    [
        (Outcome([FAULT, FAULT], VALUES["rest"]), 1, "2 faults;"),
        (StepSkipped("no unit", FAULT), 1, "1 faults, 1 steps skipped;"),
        (StepSkipped("no unit"), 1, "0 faults, 1 steps skipped;"),
        (StepSkipped("the configuration has no unit"), 0, "0 faults, 1 steps skipped;"),
    ],
)
def test_the_status_is_1_for_faults_and_for_steps_that_could_not_be_done(
    outcome: Outcome | StepSkipped, status: int, verdict: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    scripted = Scripted(monkeypatch, tmp_path, find=ANSWERS, rest=outcome)
    assert scripted.run("--only", "rest") == status
    assert f"verdict {verdict}" in capsys.readouterr().out
    skipped = isinstance(outcome, StepSkipped)
    assert ("rest" in scripted.report()["steps"]) != skipped
    scripted.done.clear()
    scripted.run()
    assert ("rest" in scripted.done) == skipped
    if not skipped:
        assert scripted.pictures[1][1]["rest"].findings == [FAULT, FAULT]


def test_a_guardian_that_died_is_a_fault_of_the_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scripted = Scripted(monkeypatch, tmp_path)
    scripted.lost = [Finding("guardian", "died", "once", "repeat the step")]
    assert scripted.run("--only", "dark") == 1
    assert scripted.report()["steps"]["dark"]["findings"][0]["part"] == "guardian"


def test_missing_devices_are_searched_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scripted = Scripted(monkeypatch, tmp_path, find=Outcome([FAULT], {"answers": {"gps": "no answer"}}))
    scripted.run()
    scripted.done.clear()
    scripted.run()
    assert scripted.done == ["find"]


def test_results_of_another_configuration_are_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted = Scripted(monkeypatch, tmp_path, find=ANSWERS)
    scripted.run("--only", "rest", "--only", "axes")
    path = tmp_path / "bench" / "report.json"
    stored = scripted.report()
    stored["steps"]["rest"]["config"] = "another"
    stored["steps"]["unknown"] = stored["steps"]["axes"]
    path.write_text(json.dumps(stored))
    scripted.done.clear()
    scripted.run()
    assert "rest" in scripted.done
    assert "axes" not in scripted.done
    assert "unknown" not in scripted.report()["steps"]


def test_a_step_that_was_repeated_without_arrays_has_no_arrays_of_the_earlier_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = Outcome([], VALUES["rest"], {}, {"allan": np.arange(3)})
    Scripted(monkeypatch, tmp_path, find=ANSWERS, rest=measured).run("--only", "find", "--only", "rest")
    scripted = Scripted(monkeypatch, tmp_path, rest=Outcome([FAULT], {"samples": 0}))
    scripted.run("--only", "rest")
    scripted.run("--only", "axes")
    assert scripted.pictures[-1][1]["rest"].arrays == {}


@pytest.mark.parametrize("size", [0, 100])
def test_damaged_arrays_of_a_step_are_refused_as_a_damaged_report(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dark = Outcome([], VALUES["dark"], {}, {"a": np.arange(3)})
    scripted = Scripted(monkeypatch, tmp_path, find=ANSWERS, dark=dark)
    scripted.run("--only", "find", "--only", "dark")
    (arrays,) = (tmp_path / "bench").glob("*.npz")
    arrays.write_bytes(arrays.read_bytes()[:size])
    with pytest.raises(UsageError, match=r"cannot be read \(.*\): give --again, or another --out"):
        scripted.run()


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"steps": {"rest": 1}}', '{"steps": {"rest": {}}}'])
def test_a_damaged_report_is_refused_unless_all_steps_are_done_again(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted = Scripted(monkeypatch, tmp_path)
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "report.json").write_text(text)
    with pytest.raises(UsageError, match=r"cannot be read \(.*\): give --again, or another --out"):
        scripted.run()
    assert scripted.done == []


def test_real_devices_need_a_person_or_the_word_yes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scripted = Scripted(monkeypatch, tmp_path, find=ANSWERS)
    parser = argparse.ArgumentParser()
    bringup.configure(parser)
    words = ["board_testbed", "--out", str(tmp_path / "bench"), "--only", "find"]
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(UsageError, match="the session asks a person at the bench"):
        bringup.run(parser.parse_args(words))
    assert not (tmp_path / "bench").exists()
    assert bringup.run(parser.parse_args([*words, "--yes"])) == 0
    assert scripted.done == ["find"]


def test_the_steps_are_those_of_the_configured_devices() -> None:
    config = orbit_config()
    assert steps_of(config) == [name for name in STEPS if name != "power"]
    assert steps_of(load(DEMO)) == [name for name in STEPS if name not in {"power", "gps", "strings", "wide"}]


class Guardian:
    """Test double of the guardian of the coils, which records whether it was awaited."""

    ready = False

    def wait_ready(self, patient: bool) -> None:
        assert patient
        self.ready = True


@pytest.mark.parametrize("yes", [False, True])
def test_a_real_session_asks_the_person_and_the_coils_are_zero_at_the_end(
    yes: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    guardian, off, closed = Guardian(), list[str](), list[str]()
    rig: Any = replace(_rig(), wires="of the first opening")
    monkeypatch.setattr(bringup, "linux_rig", lambda config, stack, patient: rig)
    monkeypatch.setattr(bringup, "real_rig", lambda config, stack: replace(rig, wires="with a guardian"))
    monkeypatch.setattr(bringup, "start_guardian", lambda rig, stack: guardian)
    config = reader.replace(orbit_config(), simulation=None)
    options = argparse.Namespace(config=Path("flight.yaml"), wired=None, yes=yes)
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    session: Any
    with bringup._opened(options, "", config, False) as session:
        assert session.guardian is guardian
        assert guardian.ready
        assert session.rig.wires == "with a guardian"
        assert session.hand is None
        assert session.coil_field is None
        assert (session.live is None) == yes
        session._open["coils"] = SimpleNamespace(off=lambda: off.append("off"))
        session.stack.callback(closed.append, "closed")
        session.ask("Turn it.")
        if not yes:
            assert capsys.readouterr().err == "Turn it. Then press Enter. "
            with pytest.raises(UsageError, match="the terminal was closed: the finished steps are kept"):
                session.ask("Turn it.")
    assert (off, closed) == (["off"], ["closed"])


def _rig() -> Any:
    return Rig(clock=SimpleNamespace(), wires=None, release=lambda _: None, realtime=True, seed=0)  # type: ignore[arg-type]


def test_focusing_ends_when_enter_is_pressed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bringup, "linux_rig", lambda config, stack, patient: _rig())
    monkeypatch.setattr(bringup, "real_rig", lambda config, stack: _rig())
    monkeypatch.setattr(bringup, "start_guardian", lambda rig, stack: None)
    options = argparse.Namespace(config=Path("flight.yaml"), wired=None, yes=False)
    pressed: list[Any] = []
    monkeypatch.setattr("ground.commands.bringup.select.select", lambda *words: (pressed, [], []))
    line = io.StringIO("\nmore")
    monkeypatch.setattr("sys.stdin", line)
    with bringup._opened(options, "", reader.replace(orbit_config(), simulation=None), False) as session:
        assert session.live is not None
        assert session.live("PSF width 1.20 px")
        assert line.tell() == 0
        pressed.append(line)
        assert not session.live("PSF width 1.10 px")
        assert line.tell() == 1
    assert capsys.readouterr().err == "\rPSF width 1.20 px (Enter: done) \rPSF width 1.10 px (Enter: done) "


def test_the_expected_fields_are_those_of_the_simulated_coils(tmp_path: Path) -> None:
    """The fields (T/A) have a row per axis in the configuration, but a row per coil in the session."""
    rows = [[1e-4, 2e-4, 3e-4], [4e-4, 5e-4, 6e-4], [7e-4, 8e-4, 9e-4]]
    path = tmp_path / "wired.yaml"
    path.write_text(f"extends: step_demo\nsimulation: {{coil_field: {rows}}}\n")
    found = bringup._coil_field(path, path.read_text(), load(path))
    assert found == pytest.approx(np.transpose(rows))
    assert bringup._coil_field(path, path.read_text(), reader.replace(load(path), simulation=None)) is None
