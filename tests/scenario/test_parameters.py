"""Tests that a flight uses or refuses a parameter table as a whole."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from flight.link.commands import CommandPacker, DumpParameters, LoadParameters, crc_of
from flight.link.telemetry.definitions import PARAMETER_FIELDS, PARAMETER_KEYS
from flight.link.telemetry.packets import to_text
from ground.telemetry import decode
from tests.scenario.answers import said
from tests.scenario.mode_flights import commanded
from tests.support.flights import event_names

SPINS = "tumbling"


def configured() -> dict[str, float]:
    """Return the parameter table that the configuration defines."""
    config = commanded(4.0)
    sections = {"modes": config.modes, "health": config.health}
    return {
        key: float(getattr(sections[key.partition(".")[0]], key.partition(".")[2])) for key in PARAMETER_KEYS
    }


def load(changes: dict[str, float], replaced: int | None = None) -> bytes:
    """Return the command packet that changes some values of the configured parameter table."""
    before = configured()
    crc = crc_of(list(before.values())) if replaced is None else replaced
    return CommandPacker().pack(LoadParameters(crc, tuple({**before, **changes}.values())), 5)


def test_a_loaded_limit_holds_at_once_and_the_table_is_reported(tmp_path: Path) -> None:
    dump = CommandPacker().pack(DumpParameters(), 6)
    run, channel = said(tmp_path, (1.0, load({"modes.tumble_rate": 0.02})), (1.5, dump))
    assert SPINS in event_names(run), "the body is released at 0.1 rad/s"
    tables = run["parameters"]
    assert tables["modes_tumble_rate"].tolist() == [configured()["modes.tumble_rate"], 0.02, 0.02]
    assert tables["loads"].tolist() == [0, 1, 1]
    assert tables["table"].tolist() == [0, 1, 1]
    assert not tables["kept"].any(), "this flight has no state folder"
    (answered,) = decode(channel.answers[1])["parameters"]
    assert answered == tables[-1]
    quiet, _ = said(tmp_path / "quiet", (1.5, dump))
    assert SPINS not in event_names(quiet)


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (load({"modes.tumble_rate": 0.02}, replaced=1), "the table in use has CRC"),
        (load({"modes.arrived_for": 0.2, "modes.tumble_rate": 0.02})[:-3] + b"abc", ""),
    ],
)
def test_a_table_with_a_wrong_predecessor_or_checksum_changes_nothing(
    tmp_path: Path, packet: bytes, reason: str
) -> None:
    run, _ = said(tmp_path, (1.0, packet))
    assert SPINS not in event_names(run)
    assert run["parameters"]["loads"].tolist() == [0]
    assert reason in to_text(run["command"][-1]["text"])


def test_the_ranges_of_the_command_are_within_the_ranges_of_the_schema() -> None:
    """The ranges of the command are within the ranges of the configuration schema.

    The configured values, which apply without a loaded table, are also within the ranges of the command.
    """
    config = commanded(4.0)
    for (key, value), field in zip(configured().items(), PARAMETER_FIELDS, strict=True):
        assert field.valid is not None
        assert field.valid[0] <= value <= field.valid[1]
        section, _, name = key.partition(".")
        flown = getattr(config, section)
        for bound in field.valid:
            taken = msgspec.convert({**msgspec.to_builtins(flown), name: bound}, type(flown))
            assert getattr(taken, name) == bound
