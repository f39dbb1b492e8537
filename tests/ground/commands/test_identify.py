"""Tests of `knightcube identify`: run, fit, configuration fragment, and one-line error messages."""

from __future__ import annotations

import argparse
import importlib.util
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from flight.schema.bodies import as_testbed
from flight.schema.reader import parse
from ground import report
from ground.commands import identify
from tests.ground.commands.in_process import command
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
