"""Tests that `knightcube new-satellite` writes a valid, commented configuration for its options."""

from __future__ import annotations

import io
import json
import math
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flight.schema.bodies import OrbitConfig, as_orbit
from flight.schema.reader import load
from ground.satellite_description import (
    QUESTIONS,
    largest_dipole,
    read_coils,
    sun_synchronous_inclination,
)
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.worlds.orbit import julian_date, sun_position
from tests.ground.commands.in_process import command
from tests.support.places import ROOT

GIVEN = ("--mass", "4", "--size", "3u", "--coil", "axis=xyz,dipole=0.2,current=0.1,resistance=40")

FOURTH = ("--coil", "axis=1/1/1,dipole=1,current=0.1,resistance=5")


def written(folder: Path, *words: str) -> OrbitConfig:
    """Return the configuration that the command writes for these options."""
    path = folder / "mine.yaml"
    done = command("new-satellite", *words, "--out", path)
    assert (done.returncode, done.stderr) == (0, "")
    return as_orbit(load(path))


def test_the_file_has_the_given_and_the_computed_values(tmp_path: Path) -> None:
    config = written(tmp_path, *GIVEN, "--name", "lark", "--star-camera", "15", "--release", "5")
    assert config.name == "lark"
    assert np.diag(config.craft.inertia_matrix()) == pytest.approx(
        [4 * (0.1**2 + 0.1**2) / 12, *[4 * (0.3405**2 + 0.1**2) / 12] * 2], rel=1e-3
    )
    assert config.camera is not None
    assert config.camera.field_of_view_deg == 15.0
    assert len(config.wide_cameras) == 6
    text = (tmp_path / "mine.yaml").read_text(encoding="utf-8")
    assert "extends: orbit\n" in text
    assert "0.2 A m^2 at 0.1 A" in text
    assert "release: {speed: 0.08727}" in text
    assert "--mass 4 --size 3u" in text, "the file names the command that wrote it"


def test_the_elements_fit_the_orbit_and_the_flight_check_accepts_the_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    words = ("--altitude", "420", "--inclination", "51.6", "--eccentricity", "0.005")
    done = command("new-satellite", *GIVEN, *words, "--utc", "2026-05-01T00:00:00", "--out", path, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    facts = json.loads(done.stdout)
    state = TwoLineElements(*facts["elements"]).at(julian_date("2026-05-01T00:00:00Z"))
    assert np.linalg.norm(state.position) == pytest.approx(6798e3 * (1.0 - 0.005), abs=3e3), "perigee"
    normal = np.cross(state.position, state.velocity)
    assert math.degrees(math.acos(normal[2] / np.linalg.norm(normal))) == pytest.approx(51.6, abs=0.2)
    assert facts["inclination_deg"] == 51.6
    done = command("check", path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "verdict:       ready" in done.stdout


def test_the_flight_check_accepts_a_file_with_four_coils(tmp_path: Path) -> None:
    config = written(tmp_path, *GIVEN, *FOURTH, "--star-camera", "none", "--horizon-cameras", "no")
    assert config.coils.channels == ((0, 1), (2, 3), (4, 5), (6, 7))
    assert config.coils.absent == frozenset()
    done = command("check", tmp_path / "mine.yaml")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "verdict:       ready" in done.stdout


def test_a_satellite_without_cameras_is_accepted(tmp_path: Path) -> None:
    config = written(tmp_path, *GIVEN, "--star-camera", "none", "--horizon-cameras", "no")
    assert config.camera is None
    assert config.wide_cameras == ()
    assert config.requirements.knowledge_deg is None


def test_two_rods_and_a_tilted_air_coil_are_described(tmp_path: Path) -> None:
    rods, air = "axis=xy,dipole=0.5,current=0.1,resistance=50", "axis=0/3/4,turns=200,area=0.02,resistance=30"
    config = written(tmp_path, "--mass", "8", "--size", "6u", "--coil", rods, "--coil", f"{air},current=0.12")
    assert [coil.axis for coil in config.coils.windings] == [(1, 0, 0), (0, 1, 0), (0, 0.6, 0.8)]
    assert [coil.strength() for coil in config.coils.windings] == pytest.approx([5.0, 5.0, 4.0])
    assert config.coils.limits == (0.1, 0.1, 0.12)
    assert config.coils.supply_voltage == pytest.approx(5.0)
    (tmp_path / "mine.yaml").unlink()
    assert len(written(tmp_path, "--mass", "8", "--size", "6u", "--coil", rods).coils.windings) == 2


@pytest.mark.parametrize(("utc", "hours"), [("2026-03-20T12:00:00", "10.5"), ("2026-09-01T00:00:00", "18")])
def test_the_star_camera_looks_away_from_the_sun(tmp_path: Path, utc: str, hours: str) -> None:
    config = written(tmp_path, *GIVEN, "--utc", utc, "--local-time", hours)
    assert config.camera is not None
    assert config.elements is not None
    date = julian_date(f"{utc}Z")
    state = TwoLineElements(*config.elements).at(date)
    down, normal = state.nadir, np.cross(state.position, state.velocity)
    right = -normal / np.linalg.norm(normal)
    to_body = np.array([np.cross(right, down), right, down])
    boresight = to_body.T @ attitude_matrix(np.array(config.camera.mounting))[2]
    sun = sun_position(date)
    assert math.degrees(math.acos(boresight @ sun / np.linalg.norm(sun))) > 60.0
    assert math.degrees(math.acos(boresight @ down)) == pytest.approx(112.0, abs=0.1)


def test_the_derived_values_are_those_of_the_shipped_satellites(tmp_path: Path) -> None:
    """The scaling laws reproduce the tuned values of `orbit` and `orbit_3u` within 35 %."""
    for name, words in {
        "orbit": ("--mass", "0.628", "--size", "0.1x0.1x0.1", "--coil", _coil(0.0959, 0.148, 23.0)),
        "orbit_3u": ("--mass", "4", "--size", "0.3x0.1x0.1", "--coil", _coil(0.2, 0.148, 9.13)),
    }.items():
        known = as_orbit(load(ROOT / "config" / f"{name}.yaml"))
        config = written(tmp_path, *words)
        (tmp_path / "mine.yaml").unlink()
        for ours, theirs in (
            (config.torque_noise(), known.torque_noise()),
            (config.dipole_weight(), known.dipole_weight()),
            (config.slew_duration(), known.slew_duration()),
            (config.requirements.slow_within, known.requirements.slow_within),
        ):
            assert ours == pytest.approx(theirs, rel=0.35), name
        assert (config.detumble.horizon, config.pointing.roll) == (
            known.detumble.horizon,
            known.pointing.roll,
        )


def _coil(dipole: float, current: float, resistance: float) -> str:
    return f"axis=xyz,dipole={dipole},current={current},resistance={resistance}"


def test_a_sun_synchronous_inclination_is_accepted_without_the_other_values_of_the_orbit(
    tmp_path: Path,
) -> None:
    written(tmp_path, *GIVEN, "--inclination", "sso")
    assert "inclination_deg: 97." in (tmp_path / "mine.yaml").read_text(encoding="utf-8")


def test_inclinations_and_dipoles_have_their_textbook_values() -> None:
    # The inclination of a near-circular Sun-synchronous orbit at 800 km is 98.6 deg in Vallado, Fundamentals
    # of Astrodynamics, example 11-2.
    assert sun_synchronous_inclination(800e3, 0.0) == pytest.approx(98.60, abs=0.02)
    assert sun_synchronous_inclination(6000e3, 0.0) is None
    equal = read_coils("axis=xyz,turns=80,area=0.0081,current=0.148,resistance=23")
    assert largest_dipole(tuple(equal)) == pytest.approx(80 * 0.0081 * 0.148)
    assert largest_dipole(tuple(read_coils("axis=0/3/4,dipole=1,current=1,resistance=1"))) == 0.0


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--mass", "-3"), "--mass -3: give a number from 0.1 to 500 kg"),
        (("--mass", "4", "--size", "300x100x100"), "--size 300x100x100: give a number from 0.02 to 3 m"),
        (
            ("--mass", "4", "--size", "big"),
            "--size big: give three sides in m, such as 0.3x0.1x0.1, or one of the CubeSats 1u, 1.5u",
        ),
        (("--mass", "400", "--size", "1u"), "--size 1u: 400 kg in this size has 3.52e+05 kg/m^3"),
        (("--altitude", "20000"), "--altitude 20000: give a number from 200 to 2000 km"),
        (
            ("--altitude", "500", "--eccentricity", "0.1"),
            "the perigee is at -188 km, below 150 km: for a mean altitude of 500 km give",
        ),
        (
            ("--altitude", "450x900", "--eccentricity", "0.03"),
            "--eccentricity 0.03: --altitude has perigee and apogee: omit this option",
        ),
        (("--altitude", "100x900"), "--altitude 100x900: give a number from 150 to 4000 km for perigee"),
        (("--altitude", "300x3000"), "--altitude 300x3000: the eccentricity is 0.168: give a lower apogee"),
        (("--altitude", "150x200"), "--altitude 150x200: give a number from 200 to 2000 km, or the"),
        (("--inclination", "polar"), "--inclination polar: give a number from 0 to 180 deg, or sso"),
        (("--utc", "noon"), "--utc noon: give a time such as 2026-03-20T12:00:00"),
        (("--utc", "2050-01-01T00:00:00"), "--utc 2050-01-01T00:00:00: give a year from 2001 to 2043"),
        (("--coil", "strong"), "--coil strong: 'strong' is unknown: give coils such as axis=xyz,dipole="),
        (("--coil", "axis=x,dipole=1,current=1"), "`resistance` is missing: give coils such as"),
        (("--coil", _coil(0.2, 5.0, 40.0)), "current=5.0: give a number from 0.001 to 1 A"),
        (
            ("--coil", _coil(0.2, 1.0, 40.0)),
            "40 V at the current limit, above 36 V: give a lower current limit",
        ),
        (("--coil", "axis=x,dipole=1,current=1,resistance=5"), "these coils control only one axis"),
        (("--coil", "axis=x,turns=9,current=1,resistance=5"), "give either `dipole`"),
        (
            (
                "--mass",
                "4",
                "--size",
                "3u",
                "--coil",
                "axis=xyz,dipole=1,current=0.1,resistance=5",
                *4 * FOURTH,
            ),
            "nothing was written: `coils.windings` has 7 entries: 2 to 6 coils are supported",
        ),
        (("--star-camera", "90"), "--star-camera 90: give a number from 6 to 40 deg, or none"),
        (
            ("--star-camera", "1280x960"),
            "give the pixels as `camera.columns` and `camera.rows` in the written",
        ),
        (("--name", "my satellite"), "--name my satellite: give letters, digits and underscores"),
        (("--mass", "4"), "--size, --coil are missing; on a terminal the command asks for values"),
    ],
)
def test_an_impossible_value_is_refused_in_one_line(
    words: tuple[str, ...], complaint: str, tmp_path: Path
) -> None:
    done = command("new-satellite", *words, "--out", tmp_path / "mine.yaml")
    assert done.returncode == 2
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_replaced_only_with_force(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("mine", encoding="utf-8")
    done = command("new-satellite", *GIVEN, "--out", path)
    assert done.returncode == 2
    assert "this file exists: give another --out, or --force to replace it" in done.stderr
    assert path.read_text(encoding="utf-8") == "mine"
    done = command("new-satellite", *GIVEN, "--out", path, "--force", "--json")
    assert done.returncode == 0, done.stderr
    assert load(path).name == "my_satellite"
    assert list(tmp_path.iterdir()) == [path], "no temporary file remains"


def test_a_folder_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").mkdir()
    done = command("new-satellite", *GIVEN, "--out", tmp_path / "mine.yaml", "--force")
    assert done.returncode == 2
    assert "mine.yaml: cannot be written: Is a directory" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_an_ellipse_is_given_by_perigee_and_apogee(tmp_path: Path) -> None:
    words = (*GIVEN, "--inclination", "63", "--json", "--out")
    by_ends = command("new-satellite", *words, tmp_path / "a.yaml", "--altitude", "450x900")
    given = ("--altitude", "675", "--eccentricity", "0.031901")
    by_axis = command("new-satellite", *words, tmp_path / "b.yaml", *given)
    assert by_ends.returncode == by_axis.returncode == 0, by_ends.stderr + by_axis.stderr
    ends, axis = (json.loads(done.stdout) for done in (by_ends, by_axis))
    assert "--altitude 450x900" in ends["command"]
    assert "eccentricity" not in ends["command"]
    for name, value in axis["derived"].items():
        assert ends["derived"][name] == pytest.approx(value, rel=1e-4), name


def test_the_worst_drag_is_that_at_the_perigee(tmp_path: Path) -> None:
    worst = {}
    for orbit in ("450x450", "450x900", "900x900"):
        words = (*GIVEN, "--altitude", orbit, "--json", "--out", tmp_path / f"{orbit}.yaml")
        worst[orbit] = json.loads(command("new-satellite", *words).stdout)["derived"]["disturbance"]
    assert worst["450x900"] == pytest.approx(worst["450x450"], rel=0.01)
    assert worst["450x900"] > 1.5 * worst["900x900"]


def test_weak_coils_are_warned_of(tmp_path: Path) -> None:
    words = ("--mass", "12", "--size", "6u", "--altitude", "250", "--coil", _coil(0.02, 0.1, 40.0))
    facts = json.loads(command("new-satellite", *words, "--out", tmp_path / "m.yaml", "--json").stdout)
    assert facts["derived"]["coil_torque"] < facts["derived"]["disturbance"]
    first, second = facts["warnings"]
    assert "so pointing may fail: use stronger coils or a higher orbit" in first
    assert "detumbling takes more than" in second


@pytest.mark.parametrize(("inclination", "warned"), [("0", True), ("175", True), ("30", False)])
def test_orbits_in_which_coils_cannot_point_are_warned_of(
    tmp_path: Path, inclination: str, warned: bool
) -> None:
    words = (*GIVEN, "--inclination", inclination, "--out", tmp_path / "m.yaml", "--json")
    warnings = json.loads(command("new-satellite", *words).stdout)["warnings"]
    assert any("nearly along the orbit normal" in text for text in warnings) is warned


def test_without_a_star_camera_the_report_does_not_judge_star_attitudes(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    assert command("new-satellite", *GIVEN, "--star-camera", "none", "--out", path).returncode == 0
    limits = as_orbit(load(path)).requirements
    assert (limits.fine_within, limits.knowledge_deg, limits.camera_missed_percent) == (None, None, None)
    assert limits.slow_within is not None


class Terminal(io.StringIO):
    """A test double of a terminal on which given lines are typed."""

    def isatty(self) -> bool:
        return True


def test_on_a_terminal_the_values_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "mine.yaml"
    answers = ["", "heavy", "", "4", "3u", "550", "", "", "9.5", "", GIVEN[-1], "none", "no", "5"]
    monkeypatch.setattr(sys, "stdin", Terminal("\n".join(answers) + "\n"))
    done = command("new-satellite", "--out", path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("name of the satellite [my_satellite]: mass, kg: ")
    assert "--mass heavy: give a number from 0.1 to 500 kg" in done.stderr, "asked again"
    assert "mass, kg:   this value has no default: give one\nmass, kg: " in done.stderr
    asked = path.read_text(encoding="utf-8")
    words = (*GIVEN, "--altitude", "550", "--local-time", "9.5", "--star-camera", "none", "--release", "5")
    other = command("new-satellite", *words, "--horizon-cameras", "no", "--out", tmp_path / "other.yaml")
    assert other.returncode == 0, other.stderr
    given = (tmp_path / "other.yaml").read_text(encoding="utf-8")
    assert asked.split("\n", 2)[2] == given.split("\n", 2)[2], "answers and options mean the same"


def test_the_answers_are_shown_when_the_file_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    same = "current=0.1,resistance=40"
    coils = f"axis=xy,{same},dipole=0.2 axis=z,{same},turns=200,area=0.01"
    answers = ["", "4", "3u", "", "", "", "", "", coils, "", "", ""]
    monkeypatch.setattr(sys, "stdin", Terminal("\n".join(answers) + "\n"))
    done = command("new-satellite", "--out", tmp_path / "absent" / "mine.yaml")
    assert done.returncode == 2
    assert "mine.yaml: cannot be written: No such file or directory" in done.stderr
    assert "the answers as a command:\n  knightcube new-satellite --name my_satellite --mass 4" in done.stderr


def test_every_question_has_an_option_with_help() -> None:
    shown = command("new-satellite", "--help").stdout
    for question in QUESTIONS:
        assert f"--{question.name} " in shown
    assert "examples:" in shown


def test_the_answers_are_shown_when_the_input_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("lark\n4\n"))
    monkeypatch.chdir(tmp_path)
    done = command("new-satellite")
    assert done.returncode == 2
    assert "the input has ended; to continue: " in done.stderr
    assert done.stderr.endswith("new-satellite --name lark --mass 4\n")


def test_ctrl_c_shows_the_command_that_continues(tmp_path: Path) -> None:
    main, side = pty.openpty()
    words = [sys.executable, "-m", "flight", "new-satellite", "--mass", "4"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        words, cwd=tmp_path, env=environment, stdin=side, stderr=subprocess.PIPE, text=True
    ) as process:
        os.close(side)
        assert process.stderr is not None
        assert process.stderr.read(10) == "name of th"
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    os.close(main)
    assert process.returncode == 130
    assert "nothing was written; to continue:\n  knightcube new-satellite --mass 4\n" in rest
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("size", "sides"),
    [
        ("1.5U", (0.1702, 0.1, 0.1)),
        ("4u", (0.454, 0.1, 0.1)),
        ("8U", (0.227, 0.2263, 0.2263)),
        ("12U", (0.366, 0.2263, 0.2263)),
        ("16u", (0.454, 0.2263, 0.2263)),
        ("27U", (0.366, 0.3526, 0.3526)),
    ],
)
def test_sizes_of_cubesats_are_known_in_either_case(size: str, sides: tuple[float, ...]) -> None:
    (asked,) = (question for question in QUESTIONS if question.name == "size")
    assert asked.read(size) == sides
