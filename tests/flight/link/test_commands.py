"""Tests that commands survive packing and unpacking, and that other packets are refused with a reason."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight.link.commands import (
    COMMANDS,
    LAYOUTS,
    ChangeMode,
    Clear,
    Command,
    CommandError,
    CommandPacker,
    DumpParameters,
    LoadParameters,
    Ping,
    Point,
    Slew,
    unpack,
)
from flight.link.events import EVENTS, Mode
from flight.link.telemetry.definitions import PARAMETER_FIELDS
from flight.link.telemetry.packets import LAYOUTS as TELEMETRY
from flight.link.telemetry.packets import crc16
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

PLAIN_MODES = [Mode.SAFE, Mode.DETUMBLE, Mode.HOLD, Mode.TESTBED_DEMO]

TARGETS = st.one_of(
    st.builds(
        PointingTarget,
        st.sampled_from([Goal.NADIR, Goal.VELOCITY, Goal.SUN]),
        st.just(()),
        st.one_of(st.none(), st.floats(-3.2, 3.2)),
    ),
    st.builds(PointingTarget, st.just(Goal.GROUND), st.tuples(st.floats(-1.57, 1.57), st.floats(-3.2, 3.2))),
    st.just(PointingTarget(Goal.INERTIAL, (0.6, 0.0, 0.0, 0.8))),
    st.just(PointingTarget(Goal.OBJECT)),
    st.builds(
        PointingTarget, st.just(Goal.OBJECT), st.tuples(st.floats(-6.28, 6.28), st.floats(-1.57, 1.57))
    ),
)

ANY: st.SearchStrategy[Command] = st.one_of(
    st.builds(Ping, st.integers(0, 2**32 - 1)),
    st.builds(ChangeMode, st.sampled_from(PLAIN_MODES)),
    st.builds(Slew, st.floats(-0.68, 0.68)),
    st.builds(Point, TARGETS),
    st.builds(DumpParameters),
    st.builds(
        LoadParameters,
        st.integers(0, 2**32 - 1),
        st.tuples(*(st.floats(*field.valid) for field in PARAMETER_FIELDS if field.valid)),
    ),
    st.builds(Clear, st.sampled_from([kind.name for kind in EVENTS])),
)


@given(ANY, st.integers(0, 2**62))
def test_a_command_is_equal_after_packing_and_unpacking(command: Command, utc_ns: int) -> None:
    data = CommandPacker().pack(command, utc_ns)
    assert unpack(data) == command
    assert command.packet.name in LAYOUTS
    assert command.text


@given(ANY, st.data())
def test_any_flipped_bit_is_found(command: Command, draw: st.DataObject) -> None:
    data = bytearray(CommandPacker().pack(command, 1))
    bit = draw.draw(st.integers(0, 8 * len(data) - 1))
    data[bit // 8] ^= 1 << bit % 8
    with pytest.raises(CommandError):
        unpack(bytes(data))


def test_a_command_is_a_ccsds_telecommand_and_no_telemetry() -> None:
    """Packet type and secondary header flag of a command are 1 (CCSDS 133.0-B-2, 4.1.3.3).

    No telemetry packet has the APID of a command.
    """
    data = CommandPacker().pack(Slew(0.25), 77)
    word = int.from_bytes(data[:2], "big")
    assert (word >> 13, word >> 12 & 1, word >> 11 & 1, word & 0x7FF) == (0, 1, 1, 0x204)
    assert int.from_bytes(data[4:6], "big") + 7 == len(data)
    assert crc16(data) == 0
    assert {packet.apid for packet in COMMANDS}.isdisjoint(
        layout.packet.apid for layout in TELEMETRY.values()
    )


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (Slew(math.nan), "within"),
        (Slew(0.69), "within"),
        (Slew(-math.inf), "within"),
        (ChangeMode(Mode.BOOT), "mode = 0 cannot be commanded"),
        (ChangeMode(Mode.SLEW), "mode = 4 cannot be commanded"),
        (Clear(""), "'' is not the name of an event"),
        (Clear("coil-brokn"), "'coil-brokn' is not the name of an event: did you mean coil-broken?"),
        (Clear("zzzz"), "'zzzz' is not the name of an event: use a name of the page Events"),
        (Ping(-1), "number = -1"),
    ],
)
def test_values_that_cannot_be_obeyed_are_refused_before_they_are_sent(
    command: Command, problem: str
) -> None:
    with pytest.raises(CommandError, match=problem):
        CommandPacker().pack(command, 0)


def test_values_out_of_range_are_refused_again_on_arrival() -> None:
    """A complete packet with a value out of range is refused on arrival, even if the sender accepts it."""
    for packet, fields in (("slew", {"q2": math.nan}), ("mode", {"mode": 99}), ("mode", {"mode": 0})):
        layout = LAYOUTS[packet]
        head = (layout.identifier, 0xC000, layout.length - 7, 1, 0)
        body = layout.body.pack(*head, *fields.values())
        with pytest.raises(CommandError, match=r"within|is not a mode|cannot be commanded"):
            unpack(body + crc16(body).to_bytes(2, "big"))


@pytest.mark.parametrize("cut", [0, 1, 5, 6, 14, -1])
def test_a_packet_cut_short_or_grown_is_refused(cut: int) -> None:
    data = CommandPacker().pack(Ping(3), 0)
    for wrong in (data[:cut], data + b"\0"):
        with pytest.raises(CommandError):
            unpack(wrong)


def test_random_bytes_are_always_refused_by_a_command_error() -> None:
    """None of 20,000 random packets (seed 7), half of them with a valid header, is accepted as a command."""
    generator = np.random.default_rng(7)
    heads = [layout.identifier.to_bytes(2, "big") for layout in LAYOUTS.values()]
    for k in range(20_000):
        noise = generator.bytes(int(generator.integers(0, 100)))
        data = heads[k % len(heads)] + noise if k % 2 else noise
        with contextlib.suppress(CommandError):
            pytest.fail(f"accepted as {unpack(data)}: {data!r}")


@pytest.mark.parametrize(
    ("goal", "numbers", "roll", "why"),
    [
        (Goal.NADIR, (1.0,), None, "takes 0 numbers"),
        (Goal.GROUND, (2.0, 0.0), None, "must be -90 to 90 deg"),
        (Goal.GROUND, (math.nan, 0.0), None, "finite"),
        (Goal.INERTIAL, (1.0, 1.0, 0.0, 0.0), None, "length 1"),
        (Goal.INERTIAL, (0.6, 0.0, 0.0, 0.8), 0.1, "an inertial attitude includes its roll"),
        (Goal.SUN, (), math.inf, "finite"),
        (Goal.OBJECT, (1.0,), None, "takes 0 or 2 numbers"),
        (Goal.OBJECT, (0.0, 2.0), None, "must be -90 to 90 deg"),
        (Goal.OBJECT, (), 0.5, "free roll"),
    ],
)
def test_a_target_that_defines_no_attitude_is_refused(
    goal: Goal, numbers: tuple[float, ...], roll: float | None, why: str
) -> None:
    with pytest.raises(UsageError, match=why):
        PointingTarget(goal, numbers, roll)


def test_each_command_is_printed_with_its_values() -> None:
    """The text of a command contains all its values. The default number of a ping is 0."""
    table = LoadParameters(0x1234, tuple(float(k + 1) for k in range(len(PARAMETER_FIELDS))))
    assert [
        Ping().text,
        Ping(7).text,
        ChangeMode(Mode.HOLD).text,
        ChangeMode(Mode.SAFE, "end\x07").text,
        Slew(0.25).text,
        Slew(math.nan).text,
        Clear("too-hot").text,
        DumpParameters().text,
    ] == [
        "ping 0",
        "ping 7",
        "mode hold",
        "mode safe: end\\x07",
        "slew to q2 +0.2500",
        "slew",
        "clear too-hot",
        "dump-parameters",
    ]
    assert table.text.endswith(" replacing 00001234")
