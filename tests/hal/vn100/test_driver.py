"""Tests of the driver with the emulated VN-100 in simulated time, and of the configuring commands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from hal.drivers.vn100 import (
    BAUD_RATES,
    OUTPUT_SET,
    PASSING_ERRORS,
    Question,
    Vn100,
    Vn100Settings,
    check,
    set_up,
)
from hal.drivers.vn100_protocol import Sentence, build, layout_of
from hal.interfaces.devices import ImuLink, ImuReading
from hal.interfaces.errors import CorruptData, NotResponding, OutOfRange, Refused
from knightcube.astro.quaternion import (
    NED_TO_TESTBED,
    about_axis_y,
    attitude_map,
    attitude_matrix,
    from_rotation_vector,
    multiply,
)
from sim_hal.emulators.serial_line import SOUND, LineFaults
from sim_hal.emulators.vn100 import Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES
from sim_hal.worlds.world import BodyMotion, about_thread
from tests.hal.vn100.bench_line import MISSION, at_rest, bench_line, turning

QUIET = Vn100EmulatorSettings(noise=PROFILES["none"])
FLOAT32 = 2.0**-23


def test_readings_come_at_40_hz_on_the_units_own_grid() -> None:
    bench = bench_line()
    bench.driver.configure()
    start_ns = bench.clock.now_ns()
    readings = bench.run(5.0)
    assert len(readings) == pytest.approx(200, abs=1)
    device_ns = np.array([reading.device_time_ns for reading in readings])
    assert set(np.diff(device_ns)) == {25_000_000}
    assert not (device_ns % 25_000_000).any()
    times = np.array([reading.time_ns for reading in readings])
    assert times.min() >= start_ns
    assert abs(np.diff(times) - 25_000_000).max() <= 2
    length = layout_of(OUTPUT_SET).length
    assert {r.arrival_ns - r.time_ns for r in readings} == {round(length * 10e9 / 115200)}
    assert bench.driver.link().bad_checksum == bench.driver.link().discarded_bytes == 0


def test_without_noise_the_reading_is_the_motion_at_its_time() -> None:
    bench = bench_line(unit_settings=QUIET)
    bench.driver.configure()
    for reading in bench.run(3.0):
        truth = turning(reading.time_ns)
        assert reading.quaternion == pytest.approx(truth.quaternion, abs=2 * FLOAT32)
        assert reading.rate == pytest.approx(truth.rate, abs=FLOAT32)
        assert reading.field == pytest.approx(truth.field_body, abs=1e-4 * 5 * FLOAT32)
        assert reading.acceleration == pytest.approx(truth.specific_force_body, abs=10 * FLOAT32)


def test_any_mounting_and_attitude_come_back_in_body_axes() -> None:
    rng = np.random.default_rng(8)
    mounting = from_rotation_vector(rng.normal(size=3))
    attitude = from_rotation_vector(rng.normal(size=3))
    field, force, rate = attitude_matrix(attitude) @ [0, 0, -4e-4], rng.normal(size=3), rng.normal(size=3)

    def sense(time_ns: int) -> BodyMotion:
        return BodyMotion(time_ns, attitude, rate, field, force)

    settings = replace(
        MISSION, attitude_map=attitude_map(mounting, NED_TO_TESTBED), mounting=attitude_matrix(mounting)
    )
    bench = bench_line(sense, settings, replace(QUIET, mounting=mounting))
    bench.driver.configure()
    reading = bench.run(0.1)[-1]
    assert reading.quaternion == pytest.approx(attitude, abs=4 * FLOAT32)
    assert reading.rate == pytest.approx(rate, abs=4 * FLOAT32)
    assert reading.field == pytest.approx(field, abs=1e-10)
    assert reading.acceleration == pytest.approx(force, abs=4 * FLOAT32)


def test_the_calibration_removes_the_errors_of_gyro_and_magnetometer() -> None:
    rng = np.random.default_rng(9)
    gyro, matrix = (np.eye(3) + 0.02 * rng.normal(size=(3, 3)) for _ in range(2))
    field, rate, bias = (
        np.array([3e-5, -1e-5, 2e-5]),
        np.array([0.1, -0.2, 0.05]),
        np.array([1e-6, 2e-6, -5e-7]),
    )
    mounting = from_rotation_vector(rng.normal(size=3))

    def sense(time_ns: int) -> BodyMotion:
        return BodyMotion(time_ns, mounting, gyro @ rate, matrix @ field + bias, np.array([0.0, 0.0, 9.8]))

    settings = replace(
        MISSION,
        attitude_map=attitude_map(mounting, NED_TO_TESTBED),
        mounting=attitude_matrix(mounting),
        gyro_matrix=gyro,
        field_matrix=matrix,
        field_bias=bias,
    )
    bench = bench_line(sense, settings, replace(QUIET, mounting=mounting))
    bench.driver.configure()
    reading = bench.run(0.1)[-1]
    assert reading.rate == pytest.approx(rate, abs=4 * FLOAT32)
    assert reading.field == pytest.approx(field, abs=1e-10)


def test_both_signs_of_the_quaternion_read_as_the_shorter_turn() -> None:
    def sense(time_ns: int) -> BodyMotion:
        return replace(about_thread(time_ns, 0.4, 0.0, 4.5e-4), quaternion=-about_axis_y(0.4))

    bench = bench_line(sense, unit_settings=QUIET)
    bench.driver.configure()
    assert bench.run(0.1)[-1].quaternion == pytest.approx(about_axis_y(0.4), abs=2 * FLOAT32)


def test_the_thesiss_noise_keeps_its_bounds_and_is_uniform() -> None:
    bench = bench_line(at_rest, MISSION)
    bench.driver.configure()
    readings = bench.run(50.0)
    truth = at_rest(0)
    small = multiply(np.array([r.quaternion for r in readings]), truth.quaternion * [-1, -1, -1, 1])[:, :3]
    rate = np.array([r.rate for r in readings])
    for noise, bound in ((small, 1.75e-3), (rate, 1.75e-4)):
        assert abs(noise).max() <= bound + 2 * FLOAT32
        for axis in noise.T:
            assert stats.kstest(axis, stats.uniform(-bound, 2 * bound).cdf).pvalue > 1e-3
    q2 = np.array([r.quaternion[1] for r in readings]) - truth.quaternion[1]
    assert 0.9 * 1.75e-3 < abs(q2).max() <= 1.75e-3 + 1e-6


def test_the_data_sheets_noise_has_its_density_at_the_drivers_windows() -> None:
    bench = bench_line(at_rest, MISSION, Vn100EmulatorSettings(noise=PROFILES["datasheet"]))
    bench.driver.configure()
    readings = bench.run(50.0)
    # A window of 20 samples gives 0.016 deg/s and 0.63 mG. The standard deviation of 2000 samples is known to
    # 1.6 %, and five times this uncertainty is 8 %.
    rate = np.array([r.rate for r in readings])
    field = np.array([r.field for r in readings])
    assert rate.std(axis=0) == pytest.approx(np.full(3, np.radians(0.0035) * 20 / np.sqrt(20)), rel=0.08)
    assert field.std(axis=0) == pytest.approx(np.full(3, 63e-9), rel=0.08)


def test_ascii_output_gives_the_same_without_device_time() -> None:
    bench = bench_line(settings=replace(MISSION, output="ascii"), unit_settings=QUIET)
    bench.driver.configure()
    readings = bench.run(2.0)
    assert len(readings) == pytest.approx(80, abs=1)
    for reading in readings:
        truth = turning(reading.time_ns)
        assert reading.device_time_ns == 0
        assert reading.quaternion == pytest.approx(truth.quaternion, abs=2e-6)
        assert reading.rate == pytest.approx(truth.rate, abs=1e-6)
        assert reading.field == pytest.approx(truth.field_body, abs=5.1e-9)
        assert reading.acceleration == pytest.approx(truth.specific_force_body, abs=5.1e-4)


def test_a_unit_in_any_state_is_configured() -> None:
    """A VN-100 with other outputs, and with half a command of a dead host in its buffer, is configured."""
    bench = bench_line()
    bench.line.host.send(b"\r\n" + build("WRG", 76, 1, 40, "01", "0729"))
    bench.clock.sleep_until_ns(100_000_000)
    bench.line.host.send(b"$VNWRG,75,1,2")
    bench.clock.sleep_until_ns(200_000_000)
    bench.driver.configure()
    readings = bench.run(1.0)
    assert len(readings) == pytest.approx(40, abs=1)
    assert bench.unit.registers.read(76)[0] == "0"


def test_a_unit_that_was_set_up_beforehand_is_used_as_it_is() -> None:
    bench = bench_line(settings=replace(MISSION, configure=False), unit_settings=QUIET)
    bench.line.host.send(build("WRG", 75, 1, 16, "15", "0001", "060F", "0004"))
    bench.driver.configure()
    readings = bench.run(1.0)
    assert bench.unit.registers.read(6) == ("14",)
    assert len(readings) > 45
    # VNYMR lines delay the packets, so the time of a sample is compared with the device clock.
    sampled_ns = readings[-1].device_time_ns - QUIET.uptime_ns
    assert readings[-1].quaternion == pytest.approx(turning(sampled_ns).quaternion, abs=2 * FLOAT32)


def test_a_silent_unit_is_reported_with_the_baud_rates_that_were_tried() -> None:
    bench = bench_line()
    bench.line.to_host.faults = LineFaults(silent=True)
    with pytest.raises(NotResponding, match=r"VNASY,0 in 3 tries of 100 ms at 115200 baud, no byte received"):
        bench.driver.configure()
    assert bench.clock.now_ns() == 300_000_000
    assert bench.driver.link().last_byte_ns == -1


def test_a_wrong_baud_rate_is_corrupt_data() -> None:
    bench = bench_line()
    bench.line.host.set_baud_rate(57600)
    with pytest.raises(CorruptData, match="but no valid packet: check the baud rate"):
        bench.driver.configure()
    assert bench.driver.link().packets == 0


def test_a_unit_that_sends_but_does_not_receive_is_distinguished_from_a_silent_one() -> None:
    bench = bench_line()
    bench.line.to_device.faults = LineFaults(silent=True)
    with pytest.raises(NotResponding, match="though its output arrives"):
        bench.driver.configure()


def test_a_port_that_is_gone_is_not_responding() -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.line.host.unplugged = True
    with pytest.raises(NotResponding, match="unplugged"):
        bench.driver.poll()


def test_another_model_is_refused() -> None:
    bench = bench_line()
    bench.unit.registers.values[1] = ("VN-200T-CR",)
    with pytest.raises(Refused, match="VN-200T-CR"):
        bench.driver.configure()


def test_an_error_answer_is_refused_with_its_meaning() -> None:
    bench = bench_line(baud_rate=115200)
    with pytest.raises(Refused, match=r"error 0C, insufficient baud rate"):
        bench.driver._ask(Question("WRG", (75, 1, 1, "01", "0531")))
    with pytest.raises(Refused, match=r"error 08, invalid register"):
        bench.driver._ask(Question("WRG", (200, 1)))


def test_an_echo_of_other_values_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_line()
    keep = bench.unit.registers.write

    def stubborn(number: int, fields: tuple[str, ...]) -> tuple[str, ...]:
        return ("1", "3", "5") if number == 44 else keep(number, fields)

    monkeypatch.setattr(bench.unit.registers, "write", stubborn)
    with pytest.raises(Refused, match=r"register 44 should be 0,1,5, but the unit answered 1,3,5"):
        bench.driver.configure()


@pytest.mark.parametrize("failures", [1, 2, 3])
def test_a_command_garbled_twice_is_sent_a_third_time_and_no_more(
    failures: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_line()
    sound_send = bench.line.host.send
    sent: Counter[bytes] = Counter()

    def send(data: bytes) -> None:
        sent[data] += 1
        sound_send(data if sent[data] > failures else data.replace(b",", b";", 1))

    monkeypatch.setattr(bench.line.host, "send", send)
    if failures < 3:
        bench.driver.configure()
        assert set(sent.values()) == {failures + 1}
    else:
        with pytest.raises(CorruptData, match="error 03, invalid checksum"):
            bench.driver.configure()


@pytest.mark.parametrize(
    ("faults", "least", "most"),
    [
        (LineFaults(silent=True), 0, 0),
        (LineFaults(garbage=True), 0, 0),
        (LineFaults(flip_probability=0.001), 30, 75),
        (LineFaults(cut_probability=0.3), 35, 75),
        (LineFaults(delay_ns=300_000_000), 60, 70),
        (SOUND, 79, 81),
    ],
)
def test_faults_on_the_wire_cost_readings_but_never_falsify_one(
    faults: LineFaults, least: int, most: int
) -> None:
    bench = bench_line(unit_settings=QUIET)
    bench.driver.configure()
    bench.run(0.5)
    before = bench.driver.link()
    bench.line.to_host.faults = faults
    readings = bench.run(2.0)
    after = bench.driver.link()
    # One packet may have been in transmission when the fault began.
    assert least <= len(readings) <= most + 1
    for reading in readings:
        truth = turning(reading.time_ns - faults.delay_ns)
        assert reading.quaternion == pytest.approx(truth.quaternion, abs=2 * FLOAT32)
    silent = after.bytes_received - before.bytes_received < 100
    corrupt = after.discarded_bytes > before.discarded_bytes
    assert silent == faults.silent
    assert corrupt == bool(faults.garbage or faults.flip_probability or faults.cut_probability)
    bench.line.to_host.faults = SOUND
    assert len(bench.run(1.0)) >= 39


def test_noise_between_packets_costs_no_packet() -> None:
    bench = bench_line(unit_settings=QUIET)
    bench.driver.configure()
    readings = []
    for _ in range(40):
        bench.line.to_host.noise(30, bench.clock.now_ns(), 115200)
        readings += bench.run(0.025)
    readings += bench.run(0.1)
    assert len(readings) == pytest.approx(44, abs=1)
    assert bench.driver.link().discarded_bytes == 40 * 30


def test_a_unit_that_must_not_be_set_up_is_left_alone_after_its_reset() -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(1.0)
    silent = Vn100(bench.line.host, bench.clock, replace(MISSION, configure=False))
    bench = replace(bench, driver=silent)
    bench.line.host.send(build("RST"))
    assert len(bench.run(3.0)) <= 1  # the VN-100 boots and sends only VNYMR lines, which are not readings
    assert silent.link().last_byte_ns > bench.clock.now_ns() - 50_000_000
    silent_to_unit = bench.unit.registers.read(6)
    assert silent_to_unit == ("14",)
    assert silent.recoveries == 0


@pytest.mark.parametrize(
    ("values", "not_finite", "out_of_range"),
    [
        ({}, 0, 0),
        ({0: float("nan")}, 1, 0),
        ({3: 0.9}, 0, 1),
        ({3: 1.005}, 0, 0),
        ({4: 36.0, 8: 200.0}, 0, 1),
        ({6: float("nan"), 10: -6.1}, 0, 1),
        ({6: float("nan"), 11: float("nan")}, 1, 0),
        ({8: 200.0}, 0, 1),
        ({10: -6.1}, 0, 1),
        ({10: -5.9}, 0, 0),
    ],
)
def test_impossible_values_are_counted_not_given(
    values: dict[int, float], not_finite: int, out_of_range: int
) -> None:
    readings, link = received(values)
    assert (link.not_finite, link.out_of_range) == (not_finite, out_of_range)
    assert len(readings) == 1 - not_finite - out_of_range
    for reading in readings:
        assert reading.has_rate
        assert np.linalg.norm(reading.quaternion) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("axis", "value", "not_finite"), [(0, 36.0, 0), (2, -35.0, 0), (1, float("inf"), 1), (2, float("nan"), 1)]
)
def test_a_sample_of_which_only_the_rate_is_invalid_is_given_without_a_rate(
    axis: int, value: float, not_finite: int
) -> None:
    (reading,), link = received({4 + axis: value, 9: -9.8, 10: 2.0})
    assert not reading.has_rate
    assert np.isnan(reading.rate).all()
    assert np.linalg.norm(reading.field) == pytest.approx(2e-4)
    assert np.linalg.norm(reading.acceleration) == pytest.approx(9.8)
    assert (link.not_finite, link.out_of_range) == (not_finite, 1 - not_finite)
    assert link.rejection.startswith(f"rate {'xyz'[axis]} = ")


def received(values: dict[int, float]) -> tuple[Sequence[ImuReading], ImuLink]:
    """Return the readings and counters after one packet at rest with changed values at some indices."""
    bench = bench_line()
    payload = [0.0, 0.0, 0.0, 1.0, *[0.0] * 9]
    for index, value in values.items():
        payload[index] = value
    bench.line.host.send(build("ASY", 0))
    bench.clock.sleep_until_ns(50_000_000)
    bench.driver.poll()
    bench.line.device.write(layout_of(OUTPUT_SET).pack([123, *payload]), bench.clock.now_ns())
    bench.clock.sleep_until_ns(100_000_000)
    return bench.driver.poll(), bench.driver.link()


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"rate_hz": 30}, Refused, "rate_hz = 30"),
        ({"rate_hz": 0}, Refused, "rate_hz = 0"),
        ({"rate_hz": 200}, OutOfRange, "line load at 115200 baud"),
        ({"rate_hz": 200}, OutOfRange, "raise `baud_rate`, or reduce `rate_hz` to at most 1"),
        ({"rate_hz": 100, "output": "ascii"}, OutOfRange, "line load"),
        ({"rate_hz": 80, "output": "ascii"}, Refused, "rate_hz = 80"),
        ({"unit_port": 3}, Refused, "unit_port = 3"),
    ],
)
def test_settings_beyond_the_unit_or_the_line_are_refused(
    change: dict[str, int], error: type[Exception], match: str
) -> None:
    make: Callable[..., Vn100Settings] = replace
    bench = bench_line()
    with pytest.raises(error, match=match):
        Vn100(bench.line.host, bench.clock, make(MISSION, **change))


def test_the_same_seed_gives_the_same_bytes() -> None:
    def flight() -> list[tuple[int, bytes]]:
        bench = bench_line(seed=11)
        bench.line.to_host.faults = LineFaults(flip_probability=1e-4, cut_probability=0.01)
        bench.clock.sleep_until_ns(2_000_000_000)
        return bench.line.host.receive()

    assert flight() == flight()


MODEL = ("VN-100T-CR",)
BINARY = ["RRG 1", "WRG 6 0", "WRG 44 0 1 5", "WRG 85 20 20 20 4 0 3 3 3 3 0", "WRG 76 0 20 01 0001",
          "WRG 77 0 20 01 0001", "WRG 75 1 20 05 0131 0100", "ASY 1"]  # fmt: skip
ASCII = ["RRG 1", "WRG 6 0", "WRG 44 0 1 5", "WRG 85 20 20 20 4 0 3 3 3 3 0", "WRG 76 0 20 01 0001",
         "WRG 77 0 20 01 0001", "WRG 75 0 20 01 0001", "WRG 30 0 0 0 0 3 0 1", "WRG 7 40", "WRG 6 8",
         "ASY 1"]  # fmt: skip


def converse(settings: Vn100Settings, answers: Mapping[str, tuple[str, ...]] | None = None) -> list[str]:
    """Return the commands of the set-up. The unit echoes each command for which no response is given."""
    dialogue = set_up(settings)
    asked: list[str] = []
    question = next(dialogue)
    while True:
        text = " ".join([question.command, *map(str, question.fields)])
        asked.append(text)
        echo = MODEL if question.command == "RRG" else tuple(map(str, question.fields[1:]))
        try:
            question = dialogue.send((answers or {}).get(text, echo))
        except StopIteration:
            return asked


@pytest.mark.parametrize(("output", "questions"), [("binary", BINARY), ("ascii", ASCII)])
def test_the_commands_of_the_set_up_are_those_of_the_manual(output: str, questions: list[str]) -> None:
    settings = replace(MISSION, output="binary" if output == "binary" else "ascii", rate_hz=40)
    assert converse(settings) == questions


def test_the_divisor_is_that_of_800_hz_and_the_port_that_of_the_cable() -> None:
    assert "WRG 75 2 40 05 0131 0100" in converse(replace(MISSION, unit_port=2, rate_hz=20))


@pytest.mark.parametrize(
    ("question", "echo"),
    [
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "5", "131", "100")),
        ("WRG 75 1 20 05 0131 0100", ("01", "0020", "05", "0131", "0100")),
        ("WRG 85 20 20 20 4 0 3 3 3 3 0", ("20", "20", "20", "04", "0", "3", "3.0", "3", "3", "0")),
        ("WRG 76 0 20 01 0001", ("0", "0", "00")),
    ],
)
def test_an_echo_with_other_zeros_is_the_same_number(question: str, echo: tuple[str, ...]) -> None:
    assert converse(MISSION, {question: echo}) == BINARY


@pytest.mark.parametrize(
    ("question", "echo"),
    [
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "05", "0131", "0101")),
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "05", "0131")),
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "05", "013x", "0100")),
        ("WRG 44 0 1 5", ("1", "1", "5")),
        ("WRG 6 0", ("14",)),
        ("WRG 76 0 20 01 0001", ("1", "20", "01", "0001")),
        ("WRG 76 0 20 01 0001", ()),
        ("RRG 1", ("VN-200",)),
        ("RRG 1", ()),
    ],
)
def test_an_echo_of_another_value_is_refused(question: str, echo: tuple[str, ...]) -> None:
    with pytest.raises(Refused):
        converse(MISSION, {question: echo})


def test_an_answer_belongs_to_its_command_and_register() -> None:
    question = Question("WRG", (75, 1))
    assert question.answer(Sentence("WRG", ("75", "1"), "crc16")) == ("1",)
    assert question.answer(Sentence("WRG", ("075", "1"), "crc16")) == ("1",)
    assert question.answer(Sentence("WRG", ("76", "1"), "crc16")) is None
    assert question.answer(Sentence("RRG", ("75", "1"), "crc16")) is None
    assert question.answer(Sentence("WRG", (), "crc16")) is None
    assert question.complaint(Sentence("ERR", ("0C",), "crc16")) == (12, "error 0C, insufficient baud rate")
    assert question.complaint(Sentence("WRG", ("75",), "crc16")) is None
    assert question.text() == "$VNWRG,75,1"


def test_only_errors_of_the_line_are_retried() -> None:
    """Only errors of the line are retried.

    The codes come from UM001 Table 18; -1 is an unreadable code.
    """
    assert {-1, 0x01, 0x02, 0x03, 0x0A, 0x0B, 0xFF} == PASSING_ERRORS
    assert BAUD_RATES == (115200, 230400, 921600, 460800, 57600, 38400, 19200, 9600)


@pytest.mark.parametrize(
    ("output", "rate_hz", "baud_rate", "possible"),
    [
        ("binary", 200, 460800, True),
        ("binary", 1, 9600, True),
        ("binary", 30, 921600, False),
        ("ascii", 16, 921600, False),
        ("ascii", 25, 115200, True),
        ("binary", 40, 38400, True),  # 67 bytes x 40 Hz x 10 bits = 26800 bit/s, 70 % of the line
        ("binary", 50, 38400, False),  # 87 % of the line
        ("ascii", 50, 115200, True),  # 137 bytes, 59 % of the line
        ("ascii", 100, 115200, False),  # 119 % of the line
    ],
)
def test_a_rate_must_be_one_of_the_unit_and_fit_into_80_percent_of_the_line(
    output: str, rate_hz: int, baud_rate: int, possible: bool
) -> None:
    settings = replace(MISSION, output="binary" if output == "binary" else "ascii", rate_hz=rate_hz)
    if possible:
        check(settings, baud_rate)
        return
    with pytest.raises((Refused, OutOfRange)):
        check(settings, baud_rate)


@pytest.mark.parametrize(("port", "possible"), [(0, False), (1, True), (2, True), (3, False)])
def test_the_unit_has_two_serial_ports(port: int, possible: bool) -> None:
    settings = replace(MISSION, unit_port=port)
    if possible:
        check(settings, 115200)
        return
    with pytest.raises(Refused, match="serial ports 1 and 2"):
        check(settings, 115200)
