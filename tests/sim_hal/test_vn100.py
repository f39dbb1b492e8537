"""Tests of the emulated VN-100: registers, errors, clock and messages."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.vn100_protocol import FIELDS, AsciiLine, BinaryPacket, build
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.clock import NEVER
from sim_hal.emulators.vn100 import SUPPORTED_FIELDS, Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES, REPORTS
from tests.hal.vn100.emulated_unit import Bench

WATCHED = (1, 5, 6, 7, 21, 36, 38, 43, 44, 50, 51, 74, 75)


def test_out_of_the_box_it_speaks_vnymr_at_40_hz() -> None:
    items = Bench().run(1.0)
    assert 39 <= len(items) <= 41
    for item in items:
        assert isinstance(item, AsciiLine)
        assert (item.sentence.command, item.length) == ("YMR", 122)
        assert item.sentence.checksum == "xor8"


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"$VNRRG,1*00\r\n", "03"),
        (b"$VNRRG,1*0000\r\n", "03"),
        (build("FOO"), "04"),
        (build("TAR", 1), "06"),
        (build("SFB", 0), "06"),
        (build("SIH"), "05"),
        (build("SIH", 10, 0), "05"),
        (build("SIH", 0, 0, 0, 1, 0), "06"),
        (build("SIH", "north"), "07"),
        (build("SIH", "inf"), "07"),
        (build("SIH", 0, 0, 0, 0), "07"),
        (build("WRG", 36, *(5,) * 8), "05"),
        (build("WRG", 36, *(5,) * 10), "06"),
        (build("WRG", 36, *(5,) * 8, 10.5), "07"),
        (build("WRG", 38, -1, *(5,) * 8), "07"),
        (build("WRG", 50, 1, 2), "05"),
        (build("WRG", 50, 1, 2, 3, 4), "06"),
        (build("WRG", 50, 1, 2, "nan"), "07"),
        (build("WRG", 51, 2, 0.1, 0.01), "07"),
        (build("WRG", 51, 1, 0.1), "05"),
        (build("WRG", 239, *(0,) * 9), "09"),
        (build("WRG", 240, *(0,) * 9), "09"),
        (build("RRG"), "05"),
        (build("WRG", 44, 1, 3), "05"),
        (build("WRG", 44, 1, 3, 5, 1), "06"),
        (build("WRG", 6, 7), "07"),
        (build("WRG", 7, 41), "07"),
        (build("WRG", 75, 1, 20, "08", "0001"), "07"),
        (build("WRG", 75, 1, 20, "01", "0040"), "07"),
        (build("WRG", 75, 1, 0, "01", "0001"), "07"),
        (build("WRG", 75, 1, 20, "05", "0001"), "05"),
        (build("WRG", 21, 1, 0, "nan", 0, 0, -9.8), "07"),
        (build("RRG", 99), "08"),
        (build("RRG", "x"), "08"),
        (build("WRG", 99, 1), "08"),
        (build("WRG", 1, "VN-1000"), "09"),
        (build("WRG", 8, 0, 0, 0), "09"),
        (build("WRG", 75, 1, 1, "01", "0531"), "0C"),
        (build("WRG", 5, 9600), "0C"),
        (build("BOM", 1), "07"),
    ],
)
def test_mistakes_get_their_error_codes_and_change_nothing(line: bytes, code: str) -> None:
    bench = Bench()
    bench.exchange(build("WRG", 7, 20), 0.1)
    bench.quiet()
    before = [bench.unit.registers.read(n) for n in WATCHED]
    (answer,) = bench.exchange(line)
    assert (answer.command, answer.fields) == ("ERR", (code,))
    assert [bench.unit.registers.read(n) for n in WATCHED] == before


def test_an_answer_is_checked_the_way_the_question_was() -> None:
    bench = Bench().quiet()
    for question in ("xor8", "crc16"):
        (answer,) = bench.exchange(build("RRG", 1, checksum=question))
        assert (answer.checksum, answer.fields) == (question, ("1", "VN-100T-CR"))
    assert bench.exchange(b"$VNRRG,1*XX\r\n")[0].checksum == "xor8"


def test_register_30_sets_checksum_and_trailing_fields_of_its_lines() -> None:
    bench = Bench()
    bench.exchange(build("WRG", 30, 1, 1, 0, 0, 3, 0, 1))
    line = bench.run(0.1)[-1]
    assert isinstance(line, AsciiLine)
    assert line.sentence.checksum == "crc16"
    assert line.sentence.fields[-2:] == ("T0000000000", "S0000")
    assert len(line.sentence.fields) == 12 + 2


def test_the_error_mode_may_silence_errors() -> None:
    bench = Bench().quiet()
    bench.exchange(build("WRG", 30, 0, 0, 0, 0, 1, 0, 0))
    assert bench.exchange(build("FOO")) == []


def test_the_baud_rate_changes_after_the_answer() -> None:
    bench = Bench().quiet()
    (answer,) = bench.exchange(build("WRG", 5, 230400))
    assert answer.fields == ("5", "230400")
    assert bench.exchange(build("RRG", 1)) == []
    bench.line.host.set_baud_rate(230400)
    assert bench.exchange(b"\r\n" + build("RRG", 1))[-1].fields == ("1", "VN-100T-CR")


def test_settings_outlive_a_reset_only_when_saved() -> None:
    bench = Bench()
    bench.exchange(build("WRG", 6, 2))
    bench.exchange(build("RST"), 2.0)
    assert bench.unit.registers.read(6) == ("14",)
    bench.exchange(build("WRG", 6, 2))
    saved = bench.exchange(build("WNV"), 0.6)
    assert "WNV" in {sentence.command for sentence in saved}
    bench.exchange(build("RST"), 2.0)
    assert {i.sentence.command for i in bench.run(0.5) if isinstance(i, AsciiLine)} == {"QTN"}
    bench.exchange(build("RFS"), 2.0)
    assert {i.sentence.command for i in bench.run(0.5) if isinstance(i, AsciiLine)} == {"YMR"}


def test_after_a_reset_it_is_silent_while_it_starts_and_its_clock_begins_at_zero() -> None:
    bench = Bench()
    bench.exchange(build("WRG", 75, 1, 20, "01", "0001"))
    bench.exchange(build("WNV"), 0.6)
    assert [s.command for s in bench.exchange(build("RST"), 0.02)][-1] == "RST"
    assert bench.run(0.9) == []
    packets = [item for item in bench.run(1.0) if isinstance(item, BinaryPacket)]
    assert packets[0].values == (25_000_000,)


def test_its_clock_may_run_fast_and_out_of_step() -> None:
    fast = Vn100EmulatorSettings(noise=PROFILES["none"], clock_ppm=20.0, uptime_ns=7_310_000_000)
    bench = Bench(fast).quiet()
    bench.exchange(build("WRG", 75, 1, 20, "01", "0001"))
    bench.exchange(build("ASY", 1))
    packets = [item for item in bench.run(100.0) if isinstance(item, BinaryPacket)]
    bench.run(1.0)
    last, first = packets[-1], packets[0]
    elapsed_ns = last.arrival_ns - first.arrival_ns
    counted_ns = float(last.values[0]) - float(first.values[0])
    assert counted_ns / elapsed_ns - 1.0 == pytest.approx(20e-6, rel=1e-3)
    assert float(first.values[0]) % 25_000_000 == 0.0


def test_every_ascii_type_says_what_its_register_says() -> None:
    bench = Bench()
    for report in REPORTS:
        bench.exchange(build("WRG", 6, report.async_type), 0.05)
        line = bench.run(0.1)[-1]
        assert isinstance(line, AsciiLine)
        assert line.sentence.command == report.header
        if report.register is not None and report.header != "DTV":
            answers = bench.exchange(build("RRG", report.register))
            (answer,) = [s for s in answers if s.command == "RRG"]
            assert answer.fields[1:] == line.sentence.fields


def test_every_binary_field_of_a_vn100_can_be_had_and_agrees_with_the_others() -> None:
    bench = Bench().quiet()
    values: dict[str, tuple[float, ...]] = {}
    for group, word in SUPPORTED_FIELDS.items():
        for bit, (_name, _) in enumerate(FIELDS[group]):
            if word >> bit & 1:
                echo = bench.exchange(build("WRG", 75, 0, 20, f"{1 << group:02X}", f"{1 << bit:04X}"))
                assert echo[-1].command == "WRG"
                bench.line.host.send(build("BOM", 1))
                (packet,) = bench.run(0.05)
                assert isinstance(packet, BinaryPacket)
                ((field, place),) = packet.layout.places.items()
                values[field] = tuple(float(v) for v in packet.values[place])
    a = attitude_matrix(np.array(values["attitude.quaternion"]))
    assert np.array(values["attitude.dcm"]).reshape(3, 3, order="F") == pytest.approx(a, abs=1e-6)
    accel = np.array(values["common.accel"])
    assert values["attitude.accel_ned"] == pytest.approx(a.T @ accel, abs=1e-5)
    assert values["attitude.accel_ned"] == pytest.approx([0.0, 0.0, -9.80665], abs=1e-5)
    assert values["attitude.linear_accel_ned"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    assert values["attitude.mag_ned"] == pytest.approx([4.5, 0.0, 0.0], abs=1e-5)
    yaw, pitch, roll = np.radians(values["common.yaw_pitch_roll"])
    # Euler angles 3-2-1 rotate the axes about z, then y, then x.
    (cz, cy, cx), (sz, sy, sx) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    turn_z = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
    turn_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    turn_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    assert turn_x @ turn_y @ turn_z == pytest.approx(a, abs=1e-6)


def test_known_disturbances_show_in_the_status() -> None:
    bench = Bench().quiet()
    bench.exchange(build("WRG", 75, 0, 20, "10", "0001"))
    for command, bit in (("KMD", 11), ("KAD", 12)):
        for flag in (1, 0):
            bench.exchange(build(command, flag))
            bench.line.host.send(build("BOM", 1))
            (packet,) = bench.run(0.02)
            assert isinstance(packet, BinaryPacket)
            assert packet.values == (flag << bit,)


def test_a_flood_without_a_line_end_overflows_its_buffer() -> None:
    bench = Bench().quiet()
    answers = bench.exchange(b"A" * 300, 0.1)
    assert [s.fields for s in answers] == [("02",)]
    assert bench.exchange(b"A" * 10) == []
    assert bench.exchange(b"\r\n" + build("RRG", 1))[0].command == "RRG"


def test_the_receive_buffer_holds_256_bytes() -> None:
    bench = Bench().quiet()
    question = build("RRG", 1)
    assert bench.exchange(b"A" * (256 - len(question) + 1) + question[:-1], 0.1) == []
    assert bench.exchange(question[-1:])[0].command == "RRG"
    assert [s.fields for s in bench.exchange(b"A" * 257, 0.1)] == [("02",)]


numbers = map(str, range(0, 101, 5))
field = st.sampled_from([*numbers, "8", "44", "75", "01", "FFFF", "-1", "1e9", "nan", "", "é"])
command = st.sampled_from(
    ["RRG", "WRG", "ASY", "KMD", "BOM", "WNV", "RST", "RFS", "SGB", "SIH", "TAR", "ERR", ""]
)


@given(
    st.lists(
        st.binary(max_size=40)
        | st.builds(
            lambda head, fields: b"$VN%b*XX\r\n" % ",".join((head, *fields)).encode(),
            command,
            st.lists(field, max_size=12),
        ),
        max_size=12,
    )
)
@settings(max_examples=60, deadline=None)
def test_whatever_it_receives_it_goes_on_and_can_be_restored(lines: list[bytes]) -> None:
    bench = Bench()
    for line in lines:
        bench.exchange(line, 0.03)
    bench.run(1.6)
    bench.line.host.set_baud_rate(bench.line.device.baud_rate)
    bench.exchange(b"\r\n" + build("RFS"), 1.6)
    bench.line.host.set_baud_rate(115200)
    bench.run(0.1)
    assert {i.sentence.command for i in bench.run(0.2) if isinstance(i, AsciiLine)} == {"YMR"}


def test_with_nothing_to_say_it_has_no_event_to_come() -> None:
    bench = Bench().quiet()
    assert bench.unit.next_event_ns() == NEVER
    bench.line.host.send(build("RRG", 1))
    assert bench.now_ns < bench.unit.next_event_ns() < NEVER


def test_bytes_take_their_time_on_the_line() -> None:
    bench = Bench().quiet()
    bench.line.device.write(bytes(range(100)), bench.now_ns)
    start_ns = bench.now_ns
    bench.now_ns = start_ns + round(10.5 * 10e9 / 115200)
    ((arrival_ns, data),) = bench.line.host.receive()
    assert data == bytes(range(10))
    assert arrival_ns == pytest.approx(start_ns + 10 * 10e9 / 115200, abs=1)
    bench.now_ns = start_ns + round(100 * 10e9 / 115200) + 1
    assert bench.line.host.receive()[0][1] == bytes(range(10, 100))
