"""Tests of releases: built in separate folders, activated by a rename, chosen at the start, and reverted."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import cast

import pytest

from flight import __version__
from flight.app.service import NAME, NOTE, TRIALS, FlownRelease
from flight.link.files.store import line_of, locked, to_record
from tests.deploy.boards import FIRST, SECOND, FakeBoard
from tests.deploy.scripts import script

releases = script("releases")

pytestmark = pytest.mark.skipif(
    shutil.which("systemctl") is None, reason="systemctl is missing: install systemd"
)


@pytest.fixture(scope="module")
def updated(tmp_path_factory: pytest.TempPathFactory) -> FakeBoard:
    board = FakeBoard(tmp_path_factory.mktemp("board") / "root")
    board.install("old")
    board.install("new")
    return board


@pytest.fixture
def board(updated: FakeBoard, tmp_path: Path) -> FakeBoard:
    """Return a copy of a board with the releases old and new."""
    shutil.copytree(updated.root, tmp_path / "root", symlinks=True)
    return FakeBoard(tmp_path / "root")


def _flown(board: FakeBoard, times: int) -> list[str]:
    return [board.fly()[0] for _ in range(times)]


def test_after_three_failed_starts_of_a_new_release_the_old_one_flies_and_reports_it(
    board: FakeBoard,
) -> None:
    assert _flown(board, 3) == ["new", "new", "new"]
    label, complaint = board.fly()
    assert label == "old"
    assert f"ended 3 times within a minute of its start; {FIRST} flies" in complaint
    FlownRelease({NAME: SECOND, "STATE_DIRECTORY": str(board.root / "state")}).prove()
    assert _flown(board, 5) == ["new"] * 5, "proven: power cuts no longer count"


def test_the_end_of_a_flight_resets_the_count_of_starts(board: FakeBoard) -> None:
    assert _flown(board, 2) == ["new", "new"]
    FlownRelease({NAME: SECOND, "STATE_DIRECTORY": str(board.root / "state")}).end()
    assert _flown(board, 3) == ["new", "new", "new"]
    assert _flown(board, 1) == ["old"]


DAMAGED = (
    *("", "[", "[]", "{}", '{"starts": [], "proven": 7}', '{"starts": {"a": "b"}}', '{"starts": {}}'),
    *(f'{{"starts": {{"{SECOND}": {number}}}, "proven": []}}' for number in ("Infinity", "NaN")),
    pytest.param("[" * 100_000, id="deep"),
)


@pytest.mark.parametrize("content", DAMAGED)
def test_a_damaged_record_of_the_starts_does_not_prevent_the_flight(board: FakeBoard, content: str) -> None:
    (board.root / "state").mkdir()
    (board.root / "state" / TRIALS).write_text(content, encoding="ascii")
    assert _flown(board, 1) == ["new"]
    line = line_of((board.root / "state" / TRIALS).read_bytes())
    assert line is not None
    assert json.loads(line)["starts"] == {SECOND: 1}


@pytest.mark.parametrize("content", DAMAGED[1:-1])
def test_a_wrong_record_with_a_valid_checksum_does_not_prevent_the_flight(
    board: FakeBoard, content: str
) -> None:
    assert releases.record(content).encode() == to_record(content.encode())
    (board.root / "state").mkdir()
    (board.root / "state" / TRIALS).write_text(releases.record(content), encoding="ascii")
    assert _flown(board, 1) == ["new"]


def _ours(board: FakeBoard, link: str) -> Path:
    return board.prefix / link / "venv/lib/python3/site-packages/flight/label"


def test_a_damaged_release_is_replaced_unless_none_is_intact(board: FakeBoard) -> None:
    _ours(board, "current").write_text("nEw", encoding="ascii")
    label, complaint = board.fly()
    assert label == "old"
    assert (
        f"release {SECOND}: venv/lib/python3/site-packages/flight/label is damaged; {FIRST} flies"
        in complaint
    )
    _ours(board, "previous").write_text("oLd", encoding="ascii")
    label, complaint = board.fly()
    assert label == "nEw"
    assert f"{FIRST}: venv/lib/python3/site-packages/flight/label is damaged; {SECOND} flies" in complaint


@pytest.mark.parametrize("package", ["flight", "hal", "knightcube", "sim_hal"])
def test_the_content_of_each_of_our_packages_is_compared_at_a_start(board: FakeBoard, package: str) -> None:
    current = releases.linked(board.prefix, "current")
    path = current / "venv/lib/python3/site-packages" / package / "module.py"
    path.parent.mkdir(exist_ok=True)
    path.write_text("sound", encoding="ascii")
    (current / releases.MANIFEST).write_text(releases.manifest_text(current), encoding="ascii")
    assert releases.damage(current) == ""
    path.write_text("sOund", encoding="ascii")
    assert f"{package}/module.py is damaged" in releases.damage(current)


def test_verify_fails_if_a_link_does_not_point_to_a_complete_release(board: FakeBoard) -> None:
    def verify() -> tuple[int, str]:
        words = [sys.executable, "-I", "-S", str(board.prefix / "bin/releases.py"), "verify"]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        return done.returncode, done.stdout

    assert verify() == (0, f"current: {SECOND} whole\nprevious: {FIRST} whole\n")
    (board.prefix / "previous/manifest").unlink()
    assert verify() == (1, f"current: {SECOND} whole\nprevious: none {releases.INCOMPLETE}\n")
    (board.prefix / "previous").unlink()
    assert verify() == (0, f"current: {SECOND} whole\nprevious: none\n"), "as before the first update"
    (board.prefix / "current").unlink()
    assert verify() == (1, f"current: none {releases.INCOMPLETE}\nprevious: none\n")


def test_the_size_of_libraries_is_compared_at_a_start_and_their_content_on_request(board: FakeBoard) -> None:
    library = board.prefix / "current/venv/lib/python3/site-packages/numpy/numpy.py"
    library.write_text("NUMPY\n", encoding="ascii")
    current = releases.linked(board.prefix, "current")
    assert releases.damage(current) == ""
    assert "numpy.py is damaged" in releases.damage(current, thorough=True)
    library.write_text("numpy", encoding="ascii")
    assert "another size" in releases.damage(current)
    (current / releases.MANIFEST).write_text("x", encoding="ascii")
    assert releases.damage(current) == "its manifest is damaged"


def test_a_board_without_any_usable_python_in_its_current_release_flies_the_previous_one(
    board: FakeBoard,
) -> None:
    (board.prefix / "current/venv/bin/python").unlink()
    assert board.fly()[0] == "old"


def test_rollback_flies_the_previous_release_and_back_again(board: FakeBoard) -> None:
    words = [*board.words("new")[:2], "--rollback"]
    for label in ("old", "new"):
        done = subprocess.run(words, env=board.environment(), capture_output=True, text=True, check=True)
        assert f"rolled back to {__version__}+" in done.stdout
        assert board.fly()[0] == label


def test_an_update_keeps_two_releases_also_if_it_is_repeated(board: FakeBoard) -> None:
    board.install("newest")
    before = sorted((board.prefix / "releases").iterdir())
    board.install("newest")
    assert sorted((board.prefix / "releases").iterdir()) == before
    assert [path.name for path in before] == [SECOND, f"{__version__}+3"]
    assert not list((board.prefix / "current").glob("venv/lib/python3/site-packages/ground"))


def test_an_update_of_an_incomplete_release_keeps_the_previous_one(board: FakeBoard) -> None:
    (board.prefix / "releases" / SECOND / "manifest").unlink()
    board.install("newest")
    assert (board.prefix / "releases" / FIRST / "manifest").is_file()
    assert (board.prefix / "previous").resolve().name == FIRST


def test_only_one_build_runs_at_a_time(board: FakeBoard) -> None:
    unfinished = board.prefix / "releases" / f"{__version__}+3"
    unfinished.mkdir()
    with locked(board.prefix / ".build", ""):
        done = subprocess.run(
            board.words("newest"), env=board.environment(), capture_output=True, text=True, check=False
        )
    assert done.returncode == 1
    assert "another build runs" in done.stderr
    assert unfinished.is_dir()
    board.install("newest")
    assert board.fly()[0] == "newest"


@pytest.mark.parametrize("option", ["", "--accept", "--rollback"])
def test_the_installed_files_are_on_disk_when_the_installer_ends(board: FakeBoard, option: str) -> None:
    program = board.root / "programs/sync"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\necho synced >>"{board.root}/calls"\n', encoding="ascii")
    program.chmod(0o755)
    environment = board.environment()
    environment["PATH"] = f"{program.parent}:{environment['PATH']}"
    words = [*board.words("new")[:2], option] if option else board.words("new")
    subprocess.run(words, env=environment, capture_output=True, check=True)
    assert (board.root / "calls").read_text(encoding="ascii") == "synced\n"


def test_a_release_that_fails_its_self_test_changes_nothing(board: FakeBoard) -> None:
    (board.python("").parents[1] / "label").write_text("", encoding="ascii")
    done = subprocess.run(
        board.words(""), env=board.environment(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "install: failed: " in done.stderr
    assert sorted(path.name for path in (board.prefix / "releases").iterdir()) == [FIRST, SECOND]
    assert board.fly()[0] == "new"
    board.install("newest")
    assert board.fly()[0] == "newest"


def test_a_flight_without_a_release_stores_no_record(tmp_path: Path) -> None:
    release = FlownRelease({"STATE_DIRECTORY": str(tmp_path), NOTE: ""})
    with ExitStack() as stack:
        release.serve(None, stack)  # type: ignore[arg-type] # no ticker is asked for
    release.prove()
    release.end()
    assert not list(tmp_path.iterdir())


def test_one_failed_read_keeps_the_record_of_the_releases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = {"starts": {"c": 1}, "proven": ["a", "b"]}
    (tmp_path / TRIALS).write_text(releases.record(json.dumps(record)), encoding="ascii")
    text, failures = releases._text, [OSError(5, "Input/output error")] * 2

    def read(path: Path, largest: int) -> str:
        if failures:
            raise failures.pop()
        return cast(str, text(path, largest))

    monkeypatch.setattr(releases, "_text", read)
    releases.Trials(tmp_path).count(tmp_path / "c")
    line = line_of((tmp_path / TRIALS).read_bytes())
    assert line is not None
    assert json.loads(line) == {"starts": {"c": 2}, "proven": ["a", "b"]}
