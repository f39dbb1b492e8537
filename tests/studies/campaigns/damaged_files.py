"""Campaign `damaged-files`: whether an intact release starts after one flipped bit in one file of a board.

The files are both copies of the launcher and of the safe state, the manifest and a module of the current
release, the records that flight and link have stored, and all keys. Each flip is followed by a start of the
flight with the command of its systemd unit. After a flipped bit in a record or key of the link, the link must
have all security associations and its schedule. After a flipped bit in the files of the safe state, the
program of the safe state must start. The bit is restored before the next flip.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flight.link.files.store import Incoming, Store
from flight.link.process.commanding import Timetable
from flight.link.security import COMMAND_SPIS, TELEMETRY_SPIS, Association, Gate, Vault, new_key
from flight.loop.state import StateStore, StoredState, note_boot
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from hal.interfaces.guardian import CoilReach
from tests.deploy.boards import FIRST, SECOND, FakeBoard, starts_record
from tests.flight.link.vaults import gate

FLIPS = 25
"""Flips on one board."""
SAFE = ("safe_state.py", "coils-off", "smbus_byte.py")
_SPIS = (*COMMAND_SPIS, *TELEMETRY_SPIS)


class DamagedBoard:
    """A board with two releases, stored records and keys."""

    def __init__(self, place: Path) -> None:
        self.board = FakeBoard(place / "root")
        for label in ("old", "new"):
            self.board.install(label)
        self._state, self._link = self.board.root / "state", self.board.root / "link"
        self._state.mkdir()
        (self._state / "releases.json").write_bytes(starts_record({SECOND: 1}, FIRST))
        note_boot([self._state], 7)
        StateStore(self._state, lambda *_: None).store(StoredState(boot_count=7))
        CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", ((0x42, 0xFD, 0x10),)).note(self._state)
        keys = self._link / "keys"
        keys.mkdir(parents=True)
        vault = Vault(keys, self._link / "witness")
        for spi in _SPIS:
            vault.write(Association(spi, 1, 10 * spi, new_key()))
        Timetable(keys).add(2**62, 1, 1, "ping 1")
        store = Store(self._link / "files")
        store.new_number(0)
        store.save(Incoming(1, 7, "elements/tle.txt", 100))

    def files(self) -> list[Path]:
        """Return the files that are damaged, one at a time."""
        prefix = self.board.prefix
        current = (prefix / "current").resolve()
        found = [*(prefix / "bin").iterdir(), *(prefix / "spare").iterdir(), current / "manifest"]
        found += [*current.glob("venv/lib/python3/site-packages/flight/*"), *self._state.rglob("*")]
        found += self._link.rglob("*")
        return sorted(path for path in found if path.is_file() and path.stat().st_size > 0)

    def flip(self, path: Path, bit: int) -> Result:
        """Flip a bit of a file, return the resulting faults, and undo the flip."""
        content, mode = path.read_bytes(), path.stat().st_mode
        record = (self._state / "releases.json").read_bytes()
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        label, said = self.board.fly(*self.board.unit_words("knightcube.service"))
        problems = [] if label in {"old", "new"} else [f"flies {label!r}: {said[-300:]}"]
        if path.name in SAFE and not self._safe_state_runs():
            problems.append("the safe state does not start")
        if path.is_relative_to(self._link):
            problems += self._link_problems(path)
        (self._state / "releases.json").write_bytes(record)
        path.write_bytes(content)
        path.chmod(mode)
        name = path.relative_to(self.board.root).as_posix()
        said_so = "fly: release " in said or (label, said) == ("new", "")
        return {"file": name, "bit": bit, "flies": label, "problems": problems, "reported": said_so}

    def _safe_state_runs(self) -> bool:
        """Return whether the unit of the safe state starts its program, which then reports."""
        words = self.board.unit_words("knightcube-safe.service")
        environment = {**os.environ, "RUNTIME_DIRECTORY": "", "KNIGHTCUBE_COMMANDS": ""}
        with subprocess.Popen(
            words, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
        ) as started:
            assert started.stderr is not None
            lines = iter(started.stderr.readline, "")
            runs = any("the flight software ended too often" in line for line in lines)
            os.killpg(started.pid, signal.SIGKILL)
        return runs

    def _link_problems(self, path: Path) -> list[str]:
        """Return the records that the link has lost; it may lose the record of one open transfer."""
        vault = Vault(self._link / "keys", self._link / "witness")
        opened: Gate = gate(vault)
        counters = [entry and entry.unused for entry in map(vault.read, _SPIS)]
        problems = [] if counters == [10 * spi for spi in _SPIS] else [f"counters {counters}"]
        if vault.restored or any(opened.association(spi) is None for spi in COMMAND_SPIS):
            problems.append("commands are refused")
        if [entry.command for entry in Timetable(vault.folder).entries] != ["ping 1"]:
            problems.append("the schedule is lost")
        store = Store(self._link / "files")
        if not path.is_relative_to(self._link / "files") and len(store.incoming()) != 1:
            problems.append("the transfer is lost")
        return problems


def cases(runs: int, seed: int) -> list[Case]:
    """Return boards for a total of `runs` flips."""
    sizes = [min(FLIPS, runs - done) for done in range(0, runs, FLIPS)]
    return [Case(str(number), (seed, number), {"flips": size}) for number, size in enumerate(sizes)]


def run(case: Case) -> Result:
    """Flip bits of one board, in all files with the same probability."""
    rng = np.random.default_rng(case.seed)
    with tempfile.TemporaryDirectory() as name:
        board = DamagedBoard(Path(name))
        files, flips = board.files(), []
        for _ in range(case.parameters["flips"]):
            path = files[int(rng.integers(len(files)))]
            flips.append(board.flip(path, int(rng.integers(8 * path.stat().st_size))))
    return {"flips": flips}


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Count the flips after which an intact release ran."""
    del folder
    flips = [flip for result in results for flip in result["flips"]]
    bad = [flip for flip in flips if flip["problems"] or not flip["reported"]]
    facts = {
        "flips": len(flips),
        "files": len({flip["file"] for flip in flips}),
        "current": sum(flip["flies"] == "new" for flip in flips),
        "previous": sum(flip["flies"] == "old" for flip in flips),
        "bad": [f"{flip['file']} bit {flip['bit']}: {flip['problems']}" for flip in bad],
    }
    return summary(facts)


DAMAGED_FILES = Campaign(
    "damaged-files",
    "one flipped bit in launcher, safe state, records or keys: a whole release flies",
    cases,
    run,
    summarise,
    default_runs=1000,
)
