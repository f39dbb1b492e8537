"""Tests with damaged keys, schedules, telecommands, streams and file transfers, and an attacker's frames."""

from __future__ import annotations

import binascii
import math
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.link.commands import CommandError, CommandPacker, Ping, Point, Slew, check, unpack
from flight.link.files.store import FileError, Store
from flight.link.files.transfer import CRC32, GROUND, MOST_OPEN, SATELLITE, Entity, Origin
from flight.link.files.units import PduError
from flight.link.process.commanding import Timetable
from flight.link.security import COPIES, Association, Vault, encode
from knightcube.gnc.guidance.plant import Q2_LIMIT
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from tests.support.damaged import Files, assert_one_line, chances, damage, fill, line_and_crc, offer
from tests.support.link_attacker import LinkAttacker

CONTENTS = {"elements/a": b"1 25544U\n2 25544\n" * 30, "star/b": bytes(range(256)) * 12, "empty": b""}
LARGEST = 1 << 16
TURNS, TURN_NS = 12, 3_000_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


@pytest.fixture(scope="module")
def schedule(folder: Path) -> Files:
    """Return both copies of a schedule of four commands."""
    table = Timetable(folder)
    for number in range(4):
        table.add(10**18 + number, 1, number, "point nadir")
    return {name: (folder / name).read_bytes() for name in (f"schedule.{copy}" for copy in COPIES)}


@settings(max_examples=50)
@given(chance=chances())
def test_a_damaged_schedule_is_lost_or_holds_possible_times(
    folder: Path, schedule: Files, chance: Random
) -> None:

    def read(files: Files, whole: bool) -> None:
        found = Timetable(fill(folder, files))
        assert not (whole and (found.lost or not found.entries))
        assert all(0 <= entry.at_ns < 2**63 for entry in found.entries)

    offer(chance, [schedule], read, (), line_and_crc)


@given(chances())
def test_a_key_or_counter_that_was_never_written_is_not_read(folder: Path, chance: Random) -> None:
    made = [Association(1, generation, 10**generation, bytes([generation]) * 32) for generation in (1, 2, 9)]
    examples = [{"spi-1.a": encode(one), "spi-1.b": encode(one)} for one in made]
    for name in examples[0]:
        (folder / name).touch(mode=0o600)

    def read(files: Files, whole: bool) -> None:
        found = Vault(fill(folder, files)).read(1)
        assert not (whole and found is None)
        assert found is None or any(one == found and one.key == found.key for one in made)

    offer(chance, examples, read)


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32))
def test_only_new_genuine_frames_are_admitted(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Only new authentic frames are admitted.

    Hypothesis draws only the seed, because frames depend on the keys, which are new in each run.
    """
    attacker, chance = LinkAttacker(tmp_path_factory.mktemp("link")), Random(seed)
    for _ in range(60):
        attacker.attack(chance)


@given(chances())
def test_a_damaged_telecommand_is_refused_or_can_be_obeyed(chance: Random) -> None:
    packer = CommandPacker()
    commands = (
        Ping(7),
        Slew(0.3),
        Point(PointingTarget(Goal.GROUND, (0.4, 0.3))),
        Point(PointingTarget(Goal.NADIR, roll=0.1)),
    )

    def read(files: Files, whole: bool) -> None:
        command = unpack(files["packet"])
        assert binascii.crc_hqx(files["packet"], 0xFFFF) == 0
        assert not whole or command in commands
        check(command.packet, command.fields)
        assert command.text.isprintable()
        if isinstance(command, Slew):
            assert abs(command.q2) <= Q2_LIMIT
        if isinstance(command, Point):
            assert all(map(math.isfinite, command.target.numbers))

    def reseal(data: bytes) -> bytes:
        return data[:-2] + binascii.crc_hqx(data[:-2], 0xFFFF).to_bytes(2, "big")

    offer(chance, [{"packet": packer.pack(one, 5)} for one in commands], read, (CommandError,), reseal)


@settings(max_examples=20)
@given(chance=chances())
def test_units_damaged_on_the_way_make_no_other_file(
    tmp_path_factory: pytest.TempPathFactory, chance: Random
) -> None:
    """Damaged, lost, repeated and reordered data units never produce a file with wrong contents."""
    place = tmp_path_factory.mktemp("units")
    fill(place / "files", CONTENTS)
    other = {SATELLITE: GROUND, GROUND: SATELLITE}
    ends = {number: Entity(number, Store(place / str(number)), lambda _: "", LARGEST, 0) for number in other}
    for number, to in other.items():
        name = chance.choice(list(CONTENTS))
        ends[number].send(place / "files" / name, name, to, CRC32, 1, 0, Origin())
    old: list[bytes] = []
    for turn in range(TURNS):
        for number, to in other.items():
            ends[number].work(turn * TURN_NS)
            for _ in range(8):
                unit = ends[number].unit(turn * TURN_NS)
                if unit is None:
                    break
                old.append(unit)
                fate = chance.randrange(5)
                arriving = ([unit], [damage(chance, unit)], [], [unit, unit], [chance.choice(old), unit])[
                    fate
                ]
                for one in arriving:
                    try:
                        ends[to].take(one, turn * TURN_NS)
                    except (PduError, FileError) as error:
                        assert_one_line(error)
    for number, end in ends.items():
        end.close(TURNS * TURN_NS)
        assert len(end.transfers()) <= 2 * MOST_OPEN
        received = Store(place / str(number)).received
        for path in (path for path in received.rglob("*") if path.is_file()):
            name = path.relative_to(received).as_posix()
            assert not path.is_symlink()
            assert path.stat().st_size <= LARGEST
            assert name not in CONTENTS or path.read_bytes() == CONTENTS[name]
    assert {path.name for path in place.iterdir()} <= {"files", str(SATELLITE), str(GROUND)}
