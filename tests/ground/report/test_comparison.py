"""Tests of reports on several runs: a comparison of two runs, and the table of an archive."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from copy import copy
from pathlib import Path
from typing import Any

import pytest

from flight.app.cli import main
from flight.link.telemetry.definitions import HEALTH
from flight.link.telemetry.packets import Packer
from ground.report import summarise
from ground.report.comparison import compare, format_archive, format_comparison, summarise_archive
from ground.telemetry import read_run
from tests.ground.commands.in_process import command
from tests.ground.report.synthetic import Recipe, make_run
from tests.support.packed_run import packed_run

LONG = Recipe(duration=90.0, planned=90.0, hold=30.0, rate_hz=10.0)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return two runs. The second run is shorter, has no truth log, and has a different planning horizon."""
    place = tmp_path_factory.mktemp("pair")
    first = make_run(place / "a", LONG)
    second = make_run(place / "b", Recipe(60.0, 60.0, 30.0, 10.0, truth=False))
    text = "name: x\nguidance: {horizon: %s, strategy: goal}\nsteps: [{at: 0.0, q2: 0.1}]\n"
    (first / "config.yaml").write_text(text % "10.0")
    (second / "config.yaml").write_text(text % "13.0" + "seedless: true\n")
    return first, second


def test_every_figure_has_both_values_and_the_difference_of_the_second_less_the_first(
    pair: tuple[Path, Path],
) -> None:
    facts = json.loads(command("report", *pair, "--json").stdout)
    figures = {row["figure"]: row for row in facts["figures"]}
    assert figures["duration"] == {
        "figure": "duration", "unit": "s", "a": 90.0, "b": 60.0, "difference": -30.0
    }  # fmt: skip
    alone = [summarise(read_run(folder)) for folder in pair]
    settling = [one["steps"][1]["settling_s"] for one in alone]
    row = figures["step 1: settling"]
    assert [row["a"], row["b"]] == pytest.approx(settling, rel=1e-11)
    assert row["difference"] == pytest.approx(settling[1] - settling[0])
    assert figures["streaks: frames"]["difference"] == (
        alone[1]["streaks"]["frames"] - alone[0]["streaks"]["frames"]
    )
    step = figures["step 2: overshoot"]
    assert (step["b"], step["difference"]) == (None, None), "only the first flew it"
    error = figures["estimate: rate, rms error"]
    assert error["a"] == pytest.approx(0.1, rel=1e-3)
    assert error["b"] is None, "no truth to judge by"


SATELLITE: dict[str, Any] = {
    "detumbling": {
        "periods": [{"duration_s": 20.0, "largest_rate_rad_s": 0.2, "last_rate_rad_s": 0.1}] * 2,
        "rate_known_share": 0.9, "rate_error_rms_rad_s": 0.01, "restarts": 4,
    },
    "knowledge": {
        "share": {"lost": 0.1, "coarse": 0.2, "fine": 0.7}, "fine_after_s": 61.0, "fine_error_rms_rad": 0.01,
        "with_stars_error_rms_rad": 0.02, "fine_error_worst_rad": 0.03, "worst_sigmas": 3.5,
        "nees_per_axis": 0.9, "refused": 5, "fixes_refused": 6, "restarts": 7,
        "star_camera": {"with_stars_error_rms_rad": 0.04, "nees_per_axis": 1.1},
        "dipole_error_share": {"sunlight": 0.3, "shadow": 0.4},
        "description": [{"name": "coils", "error": 0.05}],
    },
    "pointing": {
        "targets": [
            {
                "target": "sun", "duration_s": 100.0, "axis_rms_rad": 0.011, "axis_worst_rad": 0.012,
                "all_axes_rms_rad": 0.013, "supply_w": 0.014, "heat_w": 0.015,
            }
        ] * 2
    },
    "requirements": [{"quantity": "detumbling time", "worst": 20.0, "unit": "s"}],
    "star_camera": {"share": 0.9, "longest_gap_s": 30.0},
    "objects": [{"number": 3, "seen": 8, "magnitude": 5.5, "sighting_sigma_rad": 1e-5}],
    "battery": {"charge_lowest": 0.7, "charge_last": 0.8, "in_j": 10.0, "out_j": 20.0},
    "rate_groups": [{"name": "control", "slips": 2, "overruns": 3}],
}  # fmt: skip


def with_other_numbers(value: Any) -> Iterator[Any]:
    """Yield one copy of a value for each of its numbers, in which this number is larger by one."""
    if isinstance(value, dict | list):
        for key, below in value.items() if isinstance(value, dict) else enumerate(value):
            for other in with_other_numbers(below):
                copied = copy(value)
                copied[key] = other
                yield copied
    elif not isinstance(value, str):
        yield value + 1


def test_every_result_of_a_satellite_is_compared() -> None:
    summary = summarise(packed_run(event=[(0.0, {"name": "started"})])) | SATELLITE
    for changed in with_other_numbers(SATELLITE):
        figures = compare(summary, summary | changed)["figures"]
        assert any(row["a"] != row["b"] for row in figures), changed
    figures = {row["figure"]: row for row in compare(summary, summary)["figures"]}
    assert figures["target sun: axis error, rms"]["a"] == pytest.approx(math.degrees(0.011))
    assert figures["target sun (2): heat R I^2, average"]["a"] == pytest.approx(15.0)
    assert "control slots skipped by the loop" not in figures, "the log has no control packets"


def test_different_configuration_values_are_listed_by_their_keys(pair: tuple[Path, Path]) -> None:
    facts = json.loads(command("report", *pair, "--json").stdout)
    assert facts["configuration"] == [
        {"key": "guidance.horizon", "a": 10.0, "b": 13.0},
        {"key": "seedless", "a": None, "b": True},
    ]


def test_events_are_counted_in_both(pair: tuple[Path, Path]) -> None:
    facts = json.loads(command("report", *pair, "--json").stdout)
    assert facts["events"] == [{"name": "target", "a": 8, "b": 6}]


def test_the_text_shows_both_runs_side_by_side(pair: tuple[Path, Path]) -> None:
    done = command("report", *pair)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"A  {pair[0]}: 90.0 s of made-up on simulated devices, seed 7, lock-step")
    lines = [line.split() for line in done.stdout.splitlines()]
    assert ["guidance.horizon", "10.0", "13.0"] in lines
    assert ["duration", "s", "90", "60", "-30", "(-33", "%)"] in lines
    assert ["target", "8", "6"] in lines
    assert "note: B: no truth log: judged on the estimate" in done.stdout


def test_a_run_compared_with_itself_has_no_differences(pair: tuple[Path, Path]) -> None:
    summary = summarise(read_run(pair[0]))
    compared = compare(summary, summary)
    assert compared["configuration"] == []
    assert {row["difference"] for row in compared["figures"]} <= {0, None}
    assert "The configurations are the same" in format_comparison(compared)


def test_runs_are_compared_although_a_configuration_cannot_be_read(
    pair: tuple[Path, Path], tmp_path: Path
) -> None:
    bare = make_run(tmp_path / "bare", Recipe(5.0, 5.0, 5.0, 10.0, identity=False, commands=False))
    done = command("report", bare, pair[1])
    assert done.returncode == 0, done.stderr
    assert "Configurations not compared" in done.stdout


def test_both_are_drawn_over_each_other_where_a_folder_is_given(
    pair: tuple[Path, Path], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")
    from matplotlib.image import imread  # noqa: PLC0415

    done = command("report", *pair, "--figures", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    picture = imread(tmp_path / "new" / "comparison.png")[..., :3]
    blue = (abs(picture - [0.0, 0.447, 0.698]).max(axis=2) < 0.05).sum()
    orange = (abs(picture - [0.902, 0.624, 0.0]).max(axis=2) < 0.05).sum()
    assert min(blue, orange) > 500


def test_a_folder_that_does_not_hold_a_run_is_refused(pair: tuple[Path, Path], tmp_path: Path) -> None:
    done = command("report", pair[0], tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


SHORT = Recipe(duration=4.0, planned=4.0, hold=2.0, rate_hz=10.0)


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Return an archive of a complete run, an incomplete run, a run without log, and another folder."""
    make_run(tmp_path / "run-000001", SHORT)
    torn = make_run(tmp_path / "run-000002", SHORT) / "flight-0001.ccsds"
    torn.write_bytes(torn.read_bytes()[:-30])
    (tmp_path / "run-000003").mkdir()
    (tmp_path / "state-a.json").write_text("{}")
    return tmp_path


def test_each_boot_has_its_row_and_damage_shows(archive: Path) -> None:
    whole, torn, empty = summarise_archive(archive)["runs"]
    assert whole["duration_s"] == 4.0
    assert (whole["bad_bytes"], whole["missing_packets"]) == (0, 0)
    assert torn["bad_bytes"] > 0
    assert torn["packets"] == whole["packets"] - 1
    assert (empty["packets"], empty["end"]) == (0, "no flight log")
    text = format_archive(summarise_archive(archive))
    assert text.startswith(f"Archive {archive}: 3 runs")
    assert [line.split()[0] for line in text.splitlines()[2:]] == ["run-000001", "run-000002", "run-000003"]


def test_a_satellite_has_a_duration_and_a_damaged_log_is_not_a_missing_one(tmp_path: Path) -> None:
    packer = Packer()
    fields: dict[str, Any] = {}
    for field in HEALTH.fields:
        fields[field.name] = [0] * field.count if field.count > 1 else 0
    contents = (packer.pack(HEALTH, 7_500_000_000, fields), bytes(600))
    for number, content in enumerate(contents, start=1):
        folder = tmp_path / f"run-{number:06}"
        folder.mkdir()
        (folder / "flight-0001.ccsds").write_bytes(content)
    satellite, damaged = summarise_archive(tmp_path)["runs"]
    assert satellite["duration_s"] == 7.5
    assert damaged["end"] == "no valid packet in the 600 bytes of the flight log"


def test_the_command_reports_an_archive_as_text_and_as_json(
    archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(archive)]) == 0
    assert "run-000002" in capsys.readouterr().out
    assert main(["report", str(archive), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["runs"]) == 3
