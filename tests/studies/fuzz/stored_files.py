"""Doors of what lies on a board's disk: state, schedule, keys, releases, configurations that flew, elements.

Accepted corruption is content that was never written: what was
read must be what an example holds, or a resealed file that can be stored again.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import math
import shutil
import tempfile
import weakref
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from flight.app.accepted_config import FOLDER as FLOWN
from flight.app.accepted_config import accepted_config, kept_configs, sum_file
from flight.app.service import TRIALS, FlownRelease
from flight.link.process.commanding import Timetable
from flight.link.security import COPIES, Association, Vault
from flight.link.security import encode as sealed
from flight.loop.state import Learned, StoredState, UncleanShutdown, decode, encode
from flight.schema.document import ConfigError
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.errors import UsageError
from tests.studies.fuzz.configurations import FOLDER as CONFIGURATIONS
from tests.studies.fuzz.door import Door, DoorTarget, Files
from tests.studies.fuzz.harness import Finding

_ROOT = Path(__file__).resolve().parents[3]
_DAY = 2_461_000.5
"""A Julian date near the examples' epochs."""


class Folder:
    """A folder of its own for a door, refilled for each input."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="knightcube-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def fill(self, files: Files) -> Path:
        """Write the files over those before; their names are the same each time."""
        for name, data in files.items():
            path = self.path / name
            try:
                path.write_bytes(data)
            except FileNotFoundError:
                path.parent.mkdir(parents=True)
                path.write_bytes(data)
        return self.path


def state() -> DoorTarget:
    """Return the door of copies of the stored state."""
    kept = (
        StoredState(),
        StoredState(boot_count=7, operated=1e5, running=True, mode="point", utc="2026-11-24T00:00:00Z"),
        StoredState(
            boot_count=9,
            unclean=(UncleanShutdown(3, 12.5, ""), UncleanShutdown(8, 400.0, "x")),
            learned={"plant": Learned.of(np.array([1.0, 2.0]), np.diag([1e-4, 2e-3]))},
        ),
    )
    examples = [{"a": encode(number + 1, one)} for number, one in enumerate(kept)]
    written = {example["a"] for example in examples}

    def enter(files: Files, _: bool) -> str:
        copy = decode(files["a"])
        if encode(copy.generation, copy.state) != files["a"] and files["a"] in written:
            raise Finding("a state that comes out as another")
        decode(encode(copy.generation, copy.state))
        return "accepted"

    return DoorTarget(Door(examples, enter, (ValueError,), _line_and_crc))


def schedule() -> DoorTarget:
    """Return the door of both copies of the time-tagged commands."""
    folder, names = Folder(), [f"schedule.{copy}" for copy in COPIES]
    table = Timetable(folder.path)
    examples: list[Files] = []
    for number in range(4):
        table.add(10**18 + number, 1, number, "point nadir")
        examples.append({name: (folder.path / name).read_bytes() for name in names})

    def enter(files: Files, whole: bool) -> str:
        table = Timetable(folder.fill(files))
        if whole and (table.lost or not table.entries):
            raise Finding("a whole schedule was lost")
        for entry in table.entries:
            if not 0 <= entry.at_ns < 2**63:
                raise Finding(f"an entry at {entry.at_ns}")
        return "lost" if table.lost else "accepted"

    return DoorTarget(Door(examples, enter, (), _line_and_crc))


def keys() -> DoorTarget:
    """Return the door of both copies of a key and its counter."""
    folder = Folder()
    made = [Association(1, generation, 10**generation, bytes([generation]) * 32) for generation in (1, 2, 9)]
    examples = [{"spi-1.a": sealed(one), "spi-1.b": sealed(one)} for one in made]
    for example in examples:
        for path in example:
            (folder.path / path).touch(mode=0o600)
    vault = Vault(folder.path)

    def enter(files: Files, whole: bool) -> str:
        folder.fill(files)
        found = vault.read(1)
        if whole and found is None:
            raise Finding("a whole key was lost")
        if found is not None and not any(one == found and one.key == found.key for one in made):
            raise Finding("a key or a counter that was never written")
        return "lost" if found is None else "accepted"

    return DoorTarget(Door(examples, enter))


def releases() -> DoorTarget:
    """Return the door of two releases with their manifests, and the record of their starts."""
    chooser = _script("releases")
    folder = Folder()
    names = ("1.0.0-a", "1.1.0-b")
    example: dict[str, bytes] = {TRIALS: json.dumps({"starts": {names[1]: 2}, "proven": [names[0]]}).encode()}
    for name in names:
        release = folder.path / "releases" / name
        for place in ("flight/loop.py", "deploy/install.sh"):
            path = release / place
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{name} {place}\n" * 20, encoding="utf-8")
        (release / "manifest").write_text(chooser.manifest_text(release), encoding="utf-8")
        for path in release.rglob("*"):
            if path.is_file():
                example[path.relative_to(folder.path).as_posix()] = path.read_bytes()
    for link, name in zip(("previous", "current"), names, strict=True):
        (folder.path / link).symlink_to(folder.path / "releases" / name)
    written = dict(example)

    def enter(files: Files, whole: bool) -> str:
        place = folder.fill(files)
        found, note = chooser.choose(place, chooser.Trials(place))
        if found is None:
            raise Finding("no release was chosen")
        sound = [name for name in names if _sound(place, place / "releases" / name, written)]
        if sound and found.name not in sound:
            raise Finding("a damaged release flies, a whole one does not")
        if whole and (note or found.name != names[1]):
            raise Finding(f"the release flies that should not: {note}")
        flown = FlownRelease({"KNIGHTCUBE_RELEASE": found.name, "STATE_DIRECTORY": str(place)})
        flown.prove()
        if found.name not in chooser.Trials(place).proven:
            raise Finding("a release that has flown is not proven")
        return "noted" if note else "accepted"

    return DoorTarget(Door([example], enter))


def flown() -> DoorTarget:
    """Return the door of an accepted configuration with its sum, and two that flew before."""
    folder = Folder()
    text = (CONFIGURATIONS / "step_simulation.yaml").read_bytes()
    older = [text + b"# %d\n" % number for number in range(2)]
    example = {"flight.yaml": text, "flight.yaml.sha256": _digest(text) + b"  flight.yaml\n"}
    for number, one in enumerate(older):
        example[f"{FLOWN}/{number + 1:06d}-{_digest(one).decode()}.yaml"] = one
    known = {text.decode(), *(one.decode() for one in older)}

    def enter(files: Files, whole: bool) -> str:
        place = folder.fill(files)
        if any(one.text not in known for one in kept_configs(place)):
            raise Finding("a damaged copy counts as one that flew")
        chosen = accepted_config(place / "flight.yaml", {"STATE_DIRECTORY": str(place)})
        if chosen.text not in known:
            raise Finding("a damaged configuration flies")
        if whole and (chosen.problem or not chosen.accepted):
            raise Finding(f"a whole configuration does not fly: {chosen.problem}")
        return "another" if chosen.problem else "accepted"

    if sum_file(Path("flight.yaml")).name not in example:
        raise Finding("the sum has another name")
    return DoorTarget(Door([example], enter, (ConfigError,)))


def elements() -> DoorTarget:
    """Return the door of two-line elements."""
    lines = (
        b"1 25544U 98067A   26060.50000000  .00016717  00000-0  10270-3 0  9004\n"
        b"2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391000006"
    )
    example = {"tle": b"\n".join(_with_checksum(line) for line in lines.split(b"\n"))}

    def enter(files: Files, whole: bool) -> str:
        text = files["tle"].decode("utf-8", "replace")
        first, _, second = text.partition("\n")
        known = TwoLineElements(first, second)
        at = known.at(_DAY)
        numbers = (*at.position, *at.velocity, at.sigma)
        if not all(map(math.isfinite, numbers)):
            raise Finding(f"a place that is no number: {numbers}")
        return "accepted"

    def reseal(_: str, data: bytes) -> bytes:
        return b"\n".join(_with_checksum(line) for line in data.split(b"\n"))

    return DoorTarget(Door([example], enter, (UsageError, OrbitError), reseal))


def _with_checksum(line: bytes) -> bytes:
    line = line.ljust(69)[:68]
    total = sum(byte - 48 if 48 <= byte <= 57 else byte == 45 for byte in line)
    return line + b"%d" % (total % 10)


def _line_and_crc(_: str, data: bytes) -> bytes:
    line = data.rpartition(b"\n")[0].partition(b"\n")[0] + b"\n"
    return line + b"%08x\n" % zlib.crc32(line)


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).hexdigest().encode()


def _sound(place: Path, release: Path, written: Files) -> bool:
    """Return whether each file of a release that a start reads is as it was built."""
    ours = (release / name for name in ("flight/loop.py", "deploy/install.sh", "manifest"))
    return all(path.read_bytes() == written[path.relative_to(place).as_posix()] for path in ours)


def _script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, _ROOT / "deploy" / f"{name}.py")
    if spec is None or spec.loader is None:
        raise UsageError(f"deploy/{name}.py is missing")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
