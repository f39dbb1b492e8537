"""Tests that `fly` starts an intact release if releases.py, its record or the current release is damaged."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flight import __version__
from flight.app.service import TRIALS
from tests.deploy.boards import FIRST, SECOND, FakeBoard, starts_record
from tests.deploy.scripts import DEPLOY, ROOT, script

releases = script("releases")

pytestmark = pytest.mark.skipif(
    shutil.which("systemctl") is None, reason="systemctl is missing: install systemd"
)

SPARSE = 1 << 40
FLIPS, SEED = 20, 20261123


@pytest.fixture(scope="module")
def updated(tmp_path_factory: pytest.TempPathFactory) -> FakeBoard:
    board = FakeBoard(tmp_path_factory.mktemp("board") / "root")
    board.install("old")
    board.install("new")
    return board


@pytest.fixture
def board(updated: FakeBoard, tmp_path: Path) -> FakeBoard:
    """Return a copy of a board with the current release "new" and the previous release "old"."""
    shutil.copytree(updated.root, tmp_path / "root", symlinks=True)
    (tmp_path / "root/state").mkdir()
    return FakeBoard(tmp_path / "root")


def _chooser(board: FakeBoard) -> Path:
    return board.prefix / "bin/releases.py"


def _python(board: FakeBoard, link: str) -> Path:
    return board.prefix / link / "venv/bin/python"


def _replace(path: Path, content: str | bytes) -> None:
    """Replace a file by a file of the same size or by a longer file."""
    size = path.stat().st_size
    path.unlink()
    path.write_bytes((content if isinstance(content, bytes) else content.encode()).ljust(size, b"\n"))
    path.chmod(0o755)


def _fifo(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def _folder(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.mkdir()


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, SPARSE)


def _text(content: str) -> Callable[[Path], None]:
    return lambda path: void(path.write_text(content, encoding="utf-8"))


def void(_: object) -> None:
    """Do nothing."""


CHOOSERS: dict[str, Callable[[Path], None]] = {
    "missing": Path.unlink,
    "empty": _text(""),
    "a folder": _folder,
    "a FIFO": _fifo,
    "not Python": _text("def choose(:\n"),
    "other bytes": lambda path: void(path.write_bytes(bytes(range(256)))),
    "raises": _text("raise RuntimeError"),
    "fails without a word": _text("raise SystemExit(1)"),
    "killed": _text("import os\nos.kill(os.getpid(), 11)"),
    "loops without end": _text("while True: pass"),
    "waits, deaf to SIGTERM": _text(
        "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(600)"
    ),
    "prints without end": _text(f"while True: print('{__version__}')"),
    "names no release": _text(f"print('{__version__}+7 ')"),
    "names a path": _text("print('../../../tmp ')"),
    "names the folder": _text("print('. ')"),
    "names a pattern": _text("print('* ')"),
    "names a folder that is not a release": _text(f"print('{SECOND}/venv ')"),
}


@pytest.mark.parametrize("damage", CHOOSERS.values(), ids=CHOOSERS)
def test_without_a_usable_choice_of_releases_py_the_current_release_flies_and_reports_it(
    board: FakeBoard, damage: Callable[[Path], None]
) -> None:
    damage(_chooser(board))
    label, said = board.fly()
    assert label == "new"
    named = rf"^fly: release {re.escape(SECOND)} flies \(whole\): releases\.py answered '.*', not"
    assert re.search(named, said, re.M)


def test_a_printed_choice_is_used_although_releases_py_does_not_end(board: FakeBoard) -> None:
    """A release starts once releases.py has printed its choice, even if releases.py hangs afterwards."""
    _chooser(board).write_text(
        f"import time\nprint('{FIRST} as asked', flush=True)\ntime.sleep(600)", encoding="ascii"
    )
    label, said = board.fly()
    assert (label, "flies (whole): as asked" in said) == ("old", True)


RECORDS: dict[str, Callable[[Path], None]] = {
    "a FIFO": _fifo,
    "sparse": _sparse,
    "a folder": Path.mkdir,
    "truncated": _text(f'{{"starts": {{"{SECOND}": 2}}, "prov'),
    "other bytes": lambda path: void(path.write_bytes(bytes(range(256)))),
    "a FIFO for its next version": lambda path: _fifo(path.with_suffix(".part")),
}


@pytest.mark.parametrize("damage", RECORDS.values(), ids=RECORDS)
def test_a_damaged_record_does_not_change_the_choice_of_releases_py(
    board: FakeBoard, damage: Callable[[Path], None]
) -> None:
    damage(board.root / "state" / TRIALS)
    assert board.fly() == ("new", "")


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        pytest.param(_sparse, "is not a regular file of at most", id="sparse"),
        pytest.param(
            _fifo,
            f"the symbolic link `current` does not point to a complete release; {FIRST} flies",
            id="a FIFO",
        ),
        pytest.param(
            Path.unlink,
            f"the symbolic link `current` does not point to a complete release; {FIRST} flies",
            id="missing",
        ),
    ],
)
def test_a_release_without_a_readable_manifest_is_replaced_and_the_reason_reported(
    board: FakeBoard, damage: Callable[[Path], None], reason: str
) -> None:
    damage(board.prefix / "current/manifest")
    label, said = board.fly()
    assert label == "old"
    assert reason in said


_NO_IMPORT = '    *"import flight"*) exit 1 ;;'
"""Line that makes the import of the flight software fail, in the script that replaces Python."""

PYTHONS: dict[str, Callable[[Path], None]] = {
    "missing": Path.unlink,
    "a folder": _folder,
    "not executable": lambda path: path.chmod(0o644),
    "another machine's": lambda path: _replace(path, b"\x7fELF\2\1\1" + bytes(100)),
    "without its interpreter": lambda path: _replace(path, "#!/nowhere/python\n"),
    "fails": lambda path: _replace(path, "#!/bin/sh\nexit 1\n"),
    "crashes": lambda path: _replace(path, "#!/bin/sh\nkill -SEGV $$\n"),
    "hangs": lambda path: _replace(path, "#!/bin/sh\nexec sleep 600\n"),
    "cannot import the flight": lambda path: _replace(
        path, path.read_text().replace('    *"-m flight --v', f"{_NO_IMPORT}\n    *\"-m flight --v")
    ),
}  # fmt: skip


@pytest.mark.parametrize("chooser", ["healthy", "missing"])
@pytest.mark.parametrize("damage", PYTHONS.values(), ids=PYTHONS)
def test_a_release_that_cannot_start_is_replaced_by_the_other(
    board: FakeBoard, damage: Callable[[Path], None], chooser: str
) -> None:
    damage(_python(board, "current"))
    if chooser == "missing":
        _chooser(board).unlink()
    label, said = board.fly()
    assert label == "old"
    assert f"fly: release {FIRST} flies (whole): " in said


def test_a_proven_release_that_no_longer_starts_is_replaced_too(board: FakeBoard) -> None:
    """Starts of an accepted release are not counted; if it fails to start, the previous release starts."""
    (board.root / "state" / TRIALS).write_bytes(starts_record({}, SECOND))
    PYTHONS["cannot import the flight"](_python(board, "current"))
    assert [board.fly()[0] for _ in range(4)] == ["old"] * 4


def _damage_one_file(board: FakeBoard, link: str) -> None:
    (board.prefix / link / "venv/lib/python3/site-packages/flight/label").write_text(
        "damaged", encoding="ascii"
    )


def test_without_releases_py_a_damaged_release_is_replaced_unless_none_is_intact(
    board: FakeBoard,
) -> None:
    _chooser(board).unlink()
    _damage_one_file(board, "current")
    assert board.fly()[0] == "old"
    _damage_one_file(board, "previous")
    label, said = board.fly()
    assert label == "damaged"
    assert f"fly: release {SECOND} flies (imports): " in said
    for link in ("current", "previous"):
        PYTHONS["cannot import the flight"](_python(board, link))
    label, said = board.fly()
    assert label == "damaged"
    assert f"fly: release {SECOND} flies (runs): " in said


@pytest.mark.parametrize("package", ["flight", "knightcube"])
def test_without_releases_py_damage_to_either_package_replaces_the_release(
    board: FakeBoard, package: str
) -> None:
    _chooser(board).unlink()
    _replace(board.prefix / f"current/venv/lib/python3/site-packages/{package}/label", "hu")
    assert board.fly()[0] == "old"


def test_without_releases_py_a_damaged_manifest_replaces_the_release(board: FakeBoard) -> None:
    _chooser(board).unlink()
    manifest = board.prefix / "current/manifest"
    manifest.write_text(manifest.read_text(encoding="ascii").replace("label", "lapel"), encoding="ascii")
    assert board.fly()[0] == "old"


def test_without_releases_py_the_release_flies_that_an_operator_rolled_back_to(board: FakeBoard) -> None:
    words = [*board.words("new")[:2], "--rollback"]
    subprocess.run(words, env=board.environment(), capture_output=True, check=True)
    _chooser(board).unlink()
    assert board.fly()[0] == "old"


def test_without_its_links_the_release_with_the_highest_number_flies(board: FakeBoard) -> None:
    for link in ("current", "previous"):
        (board.prefix / link).unlink()
    releases = board.prefix / "releases"
    (releases / FIRST).rename(releases / f"{__version__}+10")
    (releases / SECOND).rename(releases / f"{__version__}+9")
    assert board.fly()[0] == "old"
    (board.prefix / "current").symlink_to(f"releases/{__version__}+9")
    assert board.fly()[0] == "new"


def test_without_any_release_it_ends_with_one_line_and_status_1(board: FakeBoard) -> None:
    shutil.rmtree(board.prefix / "releases")
    label, said = board.fly()
    assert label == ""
    assert said.splitlines()[-1] == f"fly: no release below {board.prefix}/releases can be started"


def _start(board: FakeBoard) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [str(board.prefix / "bin/fly"), "/etc/knightcube/flight.yaml", "--archive", "/a b"],
        env={**os.environ, "STATE_DIRECTORY": str(board.root / "state")},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


@pytest.mark.parametrize(
    ("chooser", "note"),
    [
        ("healthy", ""),
        ("missing", f"releases.py answered '', not the name of a release that starts; {SECOND} flies"),
    ],
)
def test_the_flight_is_the_process_that_systemd_started(board: FakeBoard, chooser: str, note: str) -> None:
    """Type=notify, the watchdog and SIGTERM need the flight as the main process."""
    python = _python(board, "current")
    flight = 'echo "$$ $9 $KNIGHTCUBE_RELEASE $KNIGHTCUBE_RELEASE_NOTE"; exec sleep 600'
    ordinary = 'echo "flies $(cat "$packages/flight/label")"'
    _replace(python, python.read_text(encoding="utf-8").replace(ordinary, flight))
    release = (board.prefix / "current").resolve()
    (release / "manifest").write_text(releases.manifest_text(release), encoding="ascii")
    if chooser == "missing":
        _chooser(board).unlink()
    with _start(board) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == -signal.SIGTERM
    assert line == f"{process.pid} /a b {SECOND} {note}\n"


def test_sigterm_ends_the_choice(board: FakeBoard, tmp_path: Path) -> None:
    _chooser(board).write_text(
        f"import time\nopen({str(tmp_path / 'begun')!r}, 'w').close()\ntime.sleep(2)\n", encoding="utf-8"
    )
    with _start(board) as process:
        while not (tmp_path / "begun").exists():
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.communicate(timeout=60)[0] == ""
    assert process.returncode == -signal.SIGTERM


def _flips(content: bytes, count: int) -> list[bytes]:
    """Return copies of some bytes, each with one flipped bit."""
    places = np.random.default_rng(SEED).choice(8 * len(content), count, replace=False)
    flipped = []
    for place in places.tolist():
        copy = bytearray(content)
        copy[place // 8] ^= 1 << place % 8
        flipped.append(bytes(copy))
    return flipped


def test_a_whole_release_flies_after_any_flipped_bit_of_releases_py(board: FakeBoard) -> None:
    whole = _chooser(board).read_bytes()
    flown = []
    for damaged in _flips(whole, FLIPS):
        _chooser(board).write_bytes(damaged)
        (board.root / "state" / TRIALS).unlink(missing_ok=True)
        flown.append(board.fly()[0])
    assert set(flown) <= {"new", "old"}


def test_a_whole_release_flies_after_any_flipped_bit_of_the_record(board: FakeBoard) -> None:
    """For every flipped bit of the record, releases.py still chooses an intact release.

    A few of the damaged records are also given to the whole launcher.
    """
    whole, state = starts_record({SECOND: 2}, FIRST), board.root / "state"
    for number, damaged in enumerate(_flips(whole, 8 * len(whole))):
        (state / TRIALS).write_bytes(damaged)
        release, _ = releases.choose(board.prefix, releases.Trials(state))
        assert release is not None
        assert release.name in {FIRST, SECOND}
        assert number >= FLIPS // 4 or board.fly()[0] in {"new", "old"}


def _damaged_copy(board: FakeBoard, name: str) -> str:
    """Start the flight as its unit does; return the label of the release, and whether damage was reported."""
    (board.root / "state" / TRIALS).unlink(missing_ok=True)
    label, said = board.fly(*board.unit_words("knightcube.service"))
    folder = board.prefix / name.partition("/")[0]
    first = name.startswith("bin/")
    assert (f"{folder} is damaged or cannot be read" in said) == first, (name, said)
    assert ("the first copy of the launcher is damaged" in said) == first, (name, said)
    return label


PROGRAMS = ("fly", "releases.py", "coils-off", "safe_state.py", "smbus_byte.py", "renewal.py", "sums")


@pytest.mark.parametrize("damage", ["flip", "missing", "a FIFO"])
@pytest.mark.parametrize("copy", ["bin", "spare"])
def test_any_damaged_file_of_the_launcher_leaves_the_current_release_flying(
    board: FakeBoard, copy: str, damage: str
) -> None:
    for number, name in enumerate(PROGRAMS if damage == "flip" else ("fly", "coils-off")):
        path = board.prefix / copy / name
        whole = path.read_bytes()
        if damage == "flip":
            path.write_bytes(_flips(whole, 8)[number])
        elif damage == "missing":
            path.unlink()
        else:
            _fifo(path)
        if damage != "a FIFO" or name == "fly":  # sha256sum never ends at a FIFO and is killed after 10 s
            assert _damaged_copy(board, f"{copy}/{name}") == "new"
        path.unlink(missing_ok=True)
        path.write_bytes(whole)
        path.chmod(0o755)
    assert _damaged_copy(board, "none") == "new"


def test_the_first_copy_starts_if_no_checksum_can_be_compared(board: FakeBoard) -> None:
    for copy in ("bin", "spare"):
        (board.prefix / copy / "sums").write_text("damaged\n", encoding="ascii")
    label, said = board.fly(*board.unit_words("knightcube.service"))
    assert label == "new"
    assert said.count("is damaged or cannot be read") == 2


@pytest.mark.parametrize(
    ("unit", "setting", "program"),
    [
        ("knightcube.service", "ExecStartPre", "coils-off"),
        ("knightcube.service", "ExecStopPost", "coils-off"),
        ("knightcube-safe.service", "ExecStartPre", "coils-off"),
        ("knightcube-safe.service", "ExecStart", "safe_state.py"),
        ("knightcube-link.service", "ExecStart", "fly"),
        ("knightcube-renewal.service", "ExecStart", "renewal.py"),
    ],
)
def test_every_unit_runs_the_second_copy_of_a_program_whose_first_copy_is_damaged(
    board: FakeBoard, unit: str, setting: str, program: str
) -> None:
    words = board.unit_words(unit, setting)
    assert words[3] == program
    spare = board.prefix / "spare"
    for copy in ("bin", "spare"):
        (board.prefix / copy / program).write_text(f"#!/bin/sh\necho {copy} $*\n", encoding="ascii")
    sums = subprocess.run(["sha256sum", program], cwd=spare, capture_output=True, check=True).stdout
    (spare / "sums").write_bytes(sums)
    done = subprocess.run([*words, "a b"], capture_output=True, text=True, check=True)
    assert done.stdout == "spare a b\n"


def test_the_link_counts_its_own_starts_and_falls_back_alone(board: FakeBoard) -> None:
    own = board.root / "link"
    own.mkdir()
    words = [*board.unit_words("knightcube-link.service"), "link", "/etc/knightcube/flight.yaml"]
    flown = []
    for _ in range(4):
        environment = {**os.environ, "STATE_DIRECTORY": str(own)}
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
        flown.append(done.stdout)
    assert flown == ["flies new\n"] * 3 + ["flies old\n"]
    assert board.fly() == ("new", "")


@pytest.mark.parametrize("program", ["run", "link"])
def test_fly_and_the_installer_try_to_import_the_same_modules(program: str) -> None:
    text = (DEPLOY / "fly").read_text(encoding="utf-8")
    (modules,) = re.findall(rf"^    {program}\) modules='(.*)' ;;$", text, re.MULTILINE)
    assert modules in (DEPLOY / "build_release.py").read_text(encoding="utf-8")
    subprocess.run([sys.executable, "-c", f"import {modules}"], cwd=ROOT, check=True)
