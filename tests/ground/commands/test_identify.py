"""Tests of `knightcube identify`: run, fit, configuration fragment, and one-line error messages."""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flight.schema.bodies import as_testbed
from flight.schema.reader import load_testbed, parse
from ground import report
from ground.commands import identify
from ground.commands.identify import _Identified
from ground.identification.fit import (
    DURATION,
    AbsolutePlant,
    MotionConstants,
    MotionNoise,
    PlantFit,
    ScaledValue,
    Whiteness,
)
from ground.identification.orbit import LearnedDescription, LearnedQuantity
from ground.identification.record import HorizontalField, Record
from knightcube.errors import UsageError
from tests.ground.commands.in_process import command
from tests.support.flights import demo_config
from tests.support.places import DEMO


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """Return the folder of a short identification run and the output of the command."""
    place = tmp_path_factory.mktemp("identify")
    words: list[str | Path] = [
        "--run",
        place / "run",
        "--out",
        place / "plant.yaml",
        "--duration",
        "60",
        "--seed",
        "5",
    ]
    done = command("identify", DEMO, *words, "--json")
    assert done.returncode == 0, done.stderr
    assert all("events" in line for line in done.stderr.splitlines())  # progress lines only
    facts: dict[str, object] = json.loads(done.stdout)
    return place, facts


def test_a_flight_finds_the_simulated_body(flown: tuple[Path, dict[str, object]]) -> None:
    """The fit finds N A B / J, k / J and c / J of config/step_demo.yaml."""
    _, facts = flown
    motion: dict[str, dict[str, float]] = facts["motion"]  # type: ignore[assignment]  # JSON
    truth = {"gain": 80 * 0.0081 * 4.5e-4 / 1.05e-3, "torsion": 1e-5 / 1.05e-3, "damping": 2e-6 / 1.05e-3}
    for name, true in truth.items():
        assert abs(motion[name]["value"] - true) < 4.0 * motion[name]["sigma"]
    assert motion["gain"]["sigma"] < 1e-3


def test_the_fragment_can_be_pasted_over_the_old_plant(flown: tuple[Path, dict[str, object]]) -> None:
    place, facts = flown
    text = (place / "plant.yaml").read_text()
    assert text == facts["fragment"]
    old = DEMO.read_text()
    head, rest = old.split("plant:", 1)
    config = as_testbed(parse(head + text + "inertial_unit:" + rest.split("inertial_unit:", 1)[1]))
    assert config.plant.thread_stiffness == pytest.approx(1e-5, rel=0.3)


def test_a_flight_that_is_done_is_identified_again_the_same(flown: tuple[Path, dict[str, object]]) -> None:
    place, facts = flown
    drawable = importlib.util.find_spec("matplotlib") is not None
    words: list[str | Path] = ["--picture", place / "fit.png"] if drawable else []
    done = command("identify", place / "run", *words)
    assert done.returncode == 0, done.stderr
    assert str(facts["fragment"]) in done.stdout
    assert "% motion with" in done.stdout
    if words:
        assert (place / "fit.png").read_bytes().startswith(b"\x89PNG")


def test_a_mistake_is_one_line_and_exit_status_2(flown: tuple[Path, dict[str, object]]) -> None:
    place, _ = flown
    for words, complaint in (
        (["identify", place / "run", "--seed", "3"], "--seed"),
        (["identify", DEMO, "--out", place / "plant.yaml"], "exists already"),
        (["identify", DEMO, "--run", place / "run"], "already contains a run"),
        (["identify", "nothing.yaml"], "nothing.yaml: cannot be read"),
    ):
        done = command(*words)
        assert done.returncode == 2
        assert complaint in done.stderr
        assert done.stderr.count("\n") == 1


def test_a_flight_with_a_broken_coil_names_what_the_flight_reported(tmp_path: Path) -> None:
    """The flight drives the other coils after it has isolated the coil."""
    config = tmp_path / "broken.yaml"
    config.write_text(DEMO.read_text() + "  faults: [{fault: 'coil-x: open'}]\n")
    done = command("identify", config, "--duration", "40", "--run", tmp_path / "run")
    assert done.returncode == 2
    assert "because the flight reported coil-broken (1): coil x" in done.stderr
    assert "repair the coil, and fly again" in done.stderr
    config.write_text(DEMO.read_text() + "  faults: [{fault: 'imu: slow', n: 2}]\n")
    done = command("identify", config, "--run", tmp_path / "other")
    assert done.returncode == 2
    assert f"{config}:{len(config.read_text().splitlines())}: `simulation.faults[0].n`" in done.stderr


def test_a_flight_too_short_to_fit_is_one_line_and_exit_status_1(tmp_path: Path) -> None:
    done = command("identify", DEMO, "--duration", "3", "--run", tmp_path / "run", "--out", tmp_path / "x")
    assert done.returncode == 1
    assert "the run is too short" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("json_asked", [False, True], ids=["text", "json"])
@pytest.mark.parametrize("drawn", [False, True], ids=["plain", "picture"])
@pytest.mark.parametrize("written", [False, True], ids=["shown", "written"])
def test_the_output_names_the_files_unless_it_is_one_json_object(
    json_asked: bool,
    drawn: bool,
    written: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    made = SimpleNamespace(fragment="plant: {}\n", record="the record", found="the fit")
    pictures: list[tuple[object, ...]] = []
    monkeypatch.setattr(identify, "_fly", lambda _: tmp_path)
    monkeypatch.setattr(identify, "_identify", lambda _: made)
    monkeypatch.setattr(identify, "_facts", lambda _: {"gain": 0.3})
    monkeypatch.setattr(identify, "_text", lambda _: "a table\n")
    monkeypatch.setattr(report, "draw_fit", lambda *words: pictures.append(words))
    out, picture = tmp_path / "plant.yaml", tmp_path / "fit.png"
    options = argparse.Namespace(
        source=str(tmp_path / "testbed.yaml"),
        out=out if written else None,
        json=json_asked,
        picture=picture if drawn else None,
    )
    assert identify.run(options) == 0
    assert pictures == ([("the record", "the fit", picture)] if drawn else [])
    assert (out.read_text(encoding="utf-8") if out.exists() else "") == (made.fragment if written else "")
    shown = capsys.readouterr().out
    if json_asked:
        assert json.loads(shown) == {"gain": 0.3}
        return
    expected = "a table\n\n" + (f"written: {out}\n" if written else made.fragment)
    assert shown == expected + (f"picture: {picture}\n" if drawn else "")


# Texts and values of artificial results.


def made(*, white: bool = True, field: bool = True, offset: float = 0.0) -> _Identified:
    """Return an artificial result of an identification."""
    count = 5
    measured = HorizontalField(4.567e-5, 1.2e-7, 80, offset) if field else None
    reported = ["imu-silent (2): no byte for 0.12 s"] if offset else []
    time = np.linspace(10.0, 52.0, count)
    record = Record(time, time, time, time, time, np.zeros(count, bool), 0.025, measured)
    innovations: Any = SimpleNamespace(restarts=frozenset({1, 3}))
    fit = PlantFit(
        MotionConstants(0.3, -0.02, 0.001, 1e-4, -2e-3, 0.05),
        np.diag([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]) ** 2,
        MotionNoise(2e-3, 3e-3, 4e-4),
        innovations,
        Whiteness((1.0, 1.1), (0.5, 0.4) if white else (0.5, 1e-9)),
    )
    plant = AbsolutePlant(
        ScaledValue(1.1e-3, 1e-5, 0.25),
        ScaledValue(0.65, 0.01, 0.5),
        ScaledValue(4.5e-5, 1e-7, 0.75),
        ScaledValue(2.9e-5, 3e-7),
        ScaledValue(1e-5, 2e-6),
        ScaledValue(2e-6, 4e-7),
        field,
        np.eye(6),
    )
    return _Identified(Path("runs/one"), demo_config(10.0, camera=False), record, fit, plant, reported)


def test_the_text_states_each_constant_with_its_uncertainty_and_its_configured_value() -> None:
    lines = identify._text(made()).splitlines()
    plant = made().config.plant
    gain = plant.coil_turns * plant.coil_area * plant.field / plant.inertia
    assert lines[0] == "flight: runs/one, 5 samples in 42 s, 2 restarts of the filter"
    assert lines[3] == f"  gain:             +3.00000e-01 +- 1.0e-02 rad/s^2/A, configured {gain:.4g}"
    assert lines[4].startswith("  torsion:          -2.00000e-02 +- 2.0e-02 1/s^2, configured ")
    assert lines[8].startswith("  delay:            +5.00000e-02 +- 6.0e-02 s, configured 0")
    assert lines[11].startswith("  inertia:           1.10000e-03 +- 1.0e-05 kg m^2")
    assert lines[11].endswith(" 25 % prior, 75 % motion with dipole and field")
    assert lines[13].endswith("T          75 % magnetometer and prior, 25 % motion with inertia and dipole")
    assert lines[14].startswith("  torque constant:   2.90000e-05 +- 3.0e-07 N m/A")
    assert lines[18] == "field:  0.4567 gauss from the magnetometer, with a scale error of 2 %"
    expected = "current 2.00 mA, angle 3.00 mrad, rate 400 urad/s; the innovations are white"
    assert lines[19] == f"noise:  {expected}"
    assert len(lines) == 20


def test_the_text_warns_of_coloured_innovations_and_of_a_field_that_was_not_measured() -> None:
    text = identify._text(made(white=False, field=False))
    assert "the innovations are NOT white: the errors are increased accordingly\n" in text
    assert "field:  as configured; not measured because the coils were never off long enough, or" in text
    assert "75 % prior, 25 % motion with inertia and dipole" in text


def test_the_text_names_what_the_flight_reported_and_the_offset_of_the_magnetometer() -> None:
    lines = identify._text(made(offset=1e-5)).splitlines()
    assert lines[1] == "reported by the flight: imu-silent (2): no byte for 0.12 s"
    assert lines[19].startswith(
        "field:  0.4567 gauss from the magnetometer minus its offset of 0.1000 gauss,"
    )
    assert identify._facts(made(offset=1e-5))["reported"] == ["imu-silent (2): no byte for 0.12 s"]


def test_the_json_object_has_the_values_of_the_text() -> None:
    facts = identify._facts(made())
    assert (facts["folder"], facts["duration_s"], facts["samples"], facts["gone_over"]) == (
        "runs/one",
        42.0,
        5,
        2,
    )
    assert facts["motion"]["damping"] == {"value": 0.001, "sigma": pytest.approx(0.03), "unit": "1/s"}
    assert facts["motion_covariance"][2][2] == pytest.approx(9e-4)
    assert facts["plant"]["dipole"] == {
        "value": 0.65, "sigma": 0.01, "own_prior": 0.5, "unit": "m^2",
        "rests_on": "50 % prior, 50 % motion with inertia and field",
    }  # fmt: skip
    assert facts["magnetometer_T"] == {"value": 4.567e-5, "sigma": 1.2e-7}
    assert facts["noise"] == {"current": 2e-3, "angle": 3e-3, "rate": 4e-4}
    assert facts["innovations"]["white"] is True
    assert identify._facts(made(white=False, field=False))["magnetometer_T"] is None
    assert identify._facts(made(white=False))["innovations"]["white"] is False


def learned() -> LearnedDescription:
    """Return two learned quantities, the dipole with an uncertainty and the gyro without."""
    dipole = LearnedQuantity(
        "dipole", ("x", "y"), "A m^2", np.array([0.0, 0.01]), np.array([0.02, 0.01]),
        np.array([0.005, 0.001]), np.array([0.05, 0.05]),
    )  # fmt: skip
    gyro = LearnedQuantity(
        "gyro", ("xx",), "", np.array([1.0]), np.array([1.002]), np.array([0.0]), np.array([0.0])
    )
    return LearnedDescription(None, 1234.4, {"dipole": dipole, "gyro": gyro})  # type: ignore[arg-type]


def test_the_table_shows_each_learned_value_with_its_change() -> None:
    lines = identify._table(learned(), Path("runs/one")).splitlines()
    assert lines[0] == "flight: runs/one, values learned until 1234 s"
    assert lines[2].split() == ["quantity", "described", "learned", "claim", "change"]
    assert lines[3] == "residual dipole x A m^2                    0         0.02     0.005    +4.0 sigma"
    assert lines[4] == "residual dipole y A m^2                 0.01         0.01     0.001    +0.0 sigma"
    assert (
        lines[5] == "gyro matrix xx                             1        1.002         0"
        "    +nan sigma, not learned"
    )
    assert [len(line.split(" sigma")[0]) for line in lines[3:6]] == [len(lines[2]) - 6] * 3


def test_a_learned_quantity_has_no_change_without_an_uncertainty() -> None:
    dipole, gyro = (identify._quantity_facts(one) for one in learned().quantities.values())
    assert dipole == {
        "unit": "A m^2", "learned": True, "described": [0.0, 0.01], "value": [0.02, 0.01],
        "claim": [0.005, 0.001], "described_sigma": [0.05, 0.05], "change_sigmas": [4.0, 0.0],
    }  # fmt: skip
    assert gyro["change_sigmas"] == [None]
    assert gyro["learned"] is False
    assert not math.isnan(gyro["value"][0])


@pytest.mark.parametrize("written", [False, True])
def test_the_run_of_a_satellite_gives_its_learned_values_without_a_fit(
    written: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "run", tmp_path / "new" / "learned.yaml"
    folder.mkdir()
    out.parent.mkdir()
    (folder / "config.yaml").write_text("extends: orbit\n")
    bases: list[str] = []

    def fragment(found: Any, of: Path, base: str) -> str:
        bases.append(base)
        return "craft: {}\n"

    monkeypatch.setattr(identify, "read_run", lambda place: place)
    monkeypatch.setattr(identify, "learned_description", lambda run, config: learned())
    monkeypatch.setattr(identify, "fragment", fragment)
    options = argparse.Namespace(
        source=folder, out=out if written else None, json=False, picture=None,
        run=None, duration=None, seed=None, realtime=False,
    )  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert identify.run(options) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"flight: {folder}, values learned until 1234 s\n")
    assert shown.endswith(f"\nwritten: {out}\n" if written else "\ncraft: {}\n")
    assert out.exists() == written
    assert bases == ["../run/config.yaml" if written else "run/config.yaml"]
    options.out, options.json = None, True
    assert identify.run(options) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["folder"], facts["time_s"], facts["fragment"]) == (str(folder), 1234.4, "craft: {}\n")
    assert list(facts["quantities"]) == ["dipole", "gyro"]
    options.picture = tmp_path / "x.png"
    with pytest.raises(UsageError, match="--picture: draws the fit of a testbed flight only"):
        identify.run(options)
    for name in ("run", "duration", "seed", "realtime"):
        options = argparse.Namespace(**{**vars(options), "picture": None, name: 3})
        with pytest.raises(UsageError, match=f"--{name}: .* is the folder of a flight, give a configuration"):
            identify.run(options)
        setattr(options, name, None)


@pytest.mark.parametrize(("duration", "given_run"), [(None, False), (45.0, True)])
def test_the_flight_has_pulses_and_the_given_duration_seed_and_folder(
    duration: float | None, given_run: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    requests: list[Any] = []
    configs: list[Any] = []
    result = SimpleNamespace(folder=tmp_path / "flown", interrupted=given_run, reason="Ctrl-C", log_error="")

    def fly(request: Any, progress: Any) -> Any:
        requests.append(request)
        configs.append(load_testbed(request.config_path))
        return result

    monkeypatch.setattr("flight.app.flight.fly", fly)
    monkeypatch.setattr("flight.app.run.default_folder", lambda path: Path("runs") / path)
    options = argparse.Namespace(
        source=DEMO, run=tmp_path / "here" if given_run else None, duration=duration, seed=4, realtime=True
    )
    assert identify._fly(options) == tmp_path / "flown"
    (request,), (config,) = requests, configs
    assert config.duration == (duration or DURATION)
    assert (request.seed, request.realtime) == (4, True)
    assert request.out == (tmp_path / "here" if given_run else Path("runs/step_demo-identify"))
    assert request.config_path.name == "step_demo.yaml"
    assert not request.config_path.exists()
    said = capsys.readouterr().err
    assert said == (
        "knightcube: Ctrl-C: the identification uses the part that was flown\n" if given_run else ""
    )
    result.interrupted, result.log_error = False, "disk full"
    identify._fly(options)
    assert capsys.readouterr().err == "knightcube: disk full\n"


def test_a_satellite_is_identified_from_a_run_only() -> None:
    options = argparse.Namespace(source=DEMO.with_name("orbit_3u.yaml"))
    with pytest.raises(UsageError, match="a satellite is identified from a run: make a run with `knightcube"):
        identify._fly(options)
