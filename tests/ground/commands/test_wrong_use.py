"""Tests that wrong use gives exit status 2 and one line with the wrong value and the permitted values."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flight.app.cli import complain, to_json
from tests.ground.commands.in_process import command
from tests.support.places import DEMO

PLAN = "plan --from 0.1 --to 0"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("plan --from 2 --to 0", "--from 2: must be -0.68 to 0.68"),
        (f"{PLAN} --horizon -1", "--horizon -1: must be 0.001 to 100000 s"),
        (f"{PLAN} --nodes 2", "--nodes 2: must be 8 to 40"),
        (f"{PLAN} --time-price 1 --horizon 20", "--horizon 20: --time-price chooses the horizon"),
        (f"{PLAN} --picture README.md", "--picture README.md: exists already and is not a PNG file"),
        (f"{PLAN} --time-price -1", "-1 is not a positive number"),
        (f"{PLAN} --picture TMP/no/where.png", "where.png: the picture cannot be written"),
        ("command --to TMP/none slew 5", "q2 = 5.0 must lie within -0.68 to 0.68"),
        ("solve TMP/sky.png --prior nan 0 0", "nan is not a finite number"),
        ("rate TMP/sky.png --prior nan 0 0", "nan is not a finite number"),
        ("run step_demo --out TMP/a --seed 1e22", "'1e22' is not a whole number from 0 to 2^64 - 1"),
        ("run step_demo --out TMP/a --seed 99999999999999999999", "from 0 to 2^64 - 1"),
        ("run step_demo --out TMP/a --realtime --devices /etc/passwd", "/etc/passwd: describes no server"),
        (
            "run step_dmo",
            "step_dmo: cannot be read: no such file; did you mean the packaged",
        ),
        ("run step_demo --duration 5s", "argument --duration: '5s' is not a number"),
        ("camera --config step_demo --count 1.5", "argument --count: '1.5' is not a whole number"),
        ("run TMP/held/flight-0001.ccsds", "is empty: give lines of the form `key: value`"),
        ("run TMP/held", "TMP/held: cannot be read: Is a directory; give the name of a file"),
        ("bringup step_demo --yes --out TMP/held/flight-0001.ccsds", "File exists; give another name"),
        ("elements --read TMP/none", "TMP/none: cannot be read: No such file or directory; check the path"),
        (
            "elements --config step_demo",
            "step_demo.yaml: `body` is testbed: this needs the",
        ),
        ("plan --orbit step_demo --from nadir --to sun --at 2026-03-01 --within 9", "`body` is testbed"),
        (
            "plan --orbit orbit --from nadir --to sun --at 2026-03-01 --within 600 --sun-cone 200",
            "--sun-cone 200: must be above 0 and below 180 deg",
        ),
        ("solve TMP/sky.pgm --camera step_demo", "64 x 64 pixels, but the camera of"),
        ("identify step_demo --run TMP/held --duration 5", "already contains a run: give another folder, or"),
    ],
)
def test_wrong_use_is_status_2(words: str, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "held").mkdir()
    (tmp_path / "held" / "flight-0001.ccsds").touch()
    (tmp_path / "sky.pgm").write_bytes(b"P5 64 64 255\n" + bytes(64 * 64))
    done = command(*words.replace("TMP", str(tmp_path)).split())
    expected = complaint.replace("TMP", str(tmp_path))
    assert (done.returncode, expected in done.stderr) == (2, True), done.stderr
    assert not (tmp_path / "no").exists(), "no folder is made for a picture"


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        ("solve TMP/none.png", 2, "TMP/none.png: cannot be read: No such file or directory"),
        ("solve", 2, "the following arguments are required: IMAGE"),
        ("rate TMP/sky.pgm", 2, "the field of view is unknown: give --fov DEG or --camera CONFIG"),
        ("index --fov 0 --out TMP/a", 2, "argument --fov: 0 is not a positive number"),
        ("plan --from 2 --to 0", 2, "--from 2: must be -0.68 to 0.68"),
        ("plan --from 0.1 --to 0 --horizon 0.01", 1, "no path was found"),
        ("calibrate TMP/sky.pgm --fov 11", 1, "TMP/sky.pgm: all pixels of the frame are equal\n--fov 11: "),
        ("nothing", 2, "argument COMMAND: invalid choice: 'nothing'"),
    ],
)
def test_a_failed_command_with_json_prints_its_error_as_json(
    words: str, status: int, message: str, tmp_path: Path
) -> None:
    (tmp_path / "sky.pgm").write_bytes(b"P5 64 64 255\n" + bytes(64 * 64))
    done = command(*words.replace("TMP", str(tmp_path)).split(), "--json")
    found = json.loads(done.stdout)
    expected = message.replace("TMP", str(tmp_path))
    assert (done.returncode, list(found), expected in found["error"]) == (status, ["error"], True), done
    assert expected.split("\n")[0] in done.stderr
    assert command(*words.replace("TMP", str(tmp_path)).split()).stdout == ""


def test_an_error_after_the_result_prints_no_second_json_object(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flight.app.cli._Answer.wanted", True)
    monkeypatch.setattr("flight.app.cli._Answer.made", False)
    printed = to_json({"stars": 7})
    assert complain("camera.yaml: cannot be written", 1) == 1
    assert (json.loads(printed), capsys.readouterr().out) == ({"stars": 7}, "")


def test_a_method_that_needs_the_field_of_view_asks_for_it(tmp_path: Path) -> None:
    (tmp_path / "sky.pgm").write_bytes(bytes(64 * 64))
    done = command("solve", tmp_path / "sky.pgm", "--raw", "64x64x8", "--method", "pyramid")
    assert done.returncode == 2
    assert "give --fov or --camera" in done.stderr


@pytest.mark.parametrize("name", ["found.jpg", "found.TIFF", "found.fits"])
def test_an_overlay_has_the_name_of_its_format(tmp_path: Path, name: str) -> None:
    (tmp_path / "sky.pgm").write_bytes(bytes(64 * 64))
    words = ("solve", tmp_path / "sky.pgm", "--raw", "64x64x8", "--fov", "15", "--overlay", tmp_path / name)
    done = command(*words)
    assert done.returncode == 2
    assert f"{name}: a PNG file is written: give a name that ends in .png" in done.stderr
    assert not (tmp_path / name).exists()


def test_samples_replace_no_file(tmp_path: Path) -> None:
    (tmp_path / "stars.png").write_bytes(b"mine")
    done = command("samples", "--out", tmp_path)
    assert done.returncode == 2
    assert f"{tmp_path}: is not empty, and its files could be replaced: give another --out" in done.stderr
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"mine"]


def test_a_command_without_a_receiver_ends_with_status_1(tmp_path: Path) -> None:
    done = command("command", "--to", tmp_path / "none", "ping")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "no flight listens there" in done.stderr


def test_the_plan_s_configuration_is_found_in_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tests.ground.commands.in_process.ROOT", tmp_path)
    assert command(*PLAN.split()).returncode == 0


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        (
            "current_limit: 0.148",
            "current_limit: 148",
            ":31: `coils.current_limit` is 148.0: must be 0.001 to 1 A",
        ),
        (
            "strategy: goal",
            "strategy: gaol",
            "`guidance.strategy` is 'gaol': expected one of goal, receding, step",
        ),
        ("name: step-demo", "body: nobody\nname: x", ":5: `body` is 'nobody': name one of testbed"),
        ("inertia:", "coil_tuns: 1\n  #", "`plant.coil_tuns` is an unknown key, did you mean"),
        ("steps:", "telemetry: {segment_bytes: 9000, budget_bytes: 17000}\nsteps:", "must be at least twice"),
        ("steps:", "commands: {udp: nowhere}\nsteps:", "expected HOST:PORT, such as"),
        (
            "steps:",
            "commands: {socket: /nowhere/x}\nsteps:",
            "`commands.socket` cannot listen on /nowhere/x",
        ),
        ("steps:", "modes: {initial: slew}\nsteps:", "expected one of detumble, hold, safe, testbed-demo"),
        (
            "star_tracker: {}",
            "star_tracker: {index: /nowhere/x}",
            "`camera.star_tracker.index` is '/nowhere/x'",
        ),
    ],
)
def test_a_bad_configuration_is_one_line_with_its_place_and_what_is_permitted(
    right: str, wrong: str, complaint: str, tmp_path: Path
) -> None:
    text = DEMO.read_text(encoding="utf-8")
    assert right in text
    path = tmp_path / "c.yaml"
    path.write_text(text.replace(right, wrong, 1), encoding="utf-8")
    done = command("run", path, "--duration", "0.1", "--out", tmp_path / "run")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert done.stderr.startswith(f"knightcube: {path}"), done.stderr
    assert complaint in done.stderr
