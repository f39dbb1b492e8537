"""Tests of the table of faults, and that each fault has an effect until its removal."""

from __future__ import annotations

import math

import pytest

from flight.schema import reader as configuration
from flight.schema.devices import Battery, Power
from hal.drivers.pca9685 import PRE_SCALE
from hal.interfaces.errors import NotResponding
from sim_hal.clock import NEVER, SimClock
from sim_hal.emulators.coil_circuit import CoilCondition
from sim_hal.emulators.serial_line import SOUND, LineFaults
from sim_hal.faults.catalogue import CATALOGUE, FaultKind, Where
from sim_hal.faults.schedule import parse, put
from sim_hal.rig import LockStep, build_lockstep
from tests.sim_hal.faults.benches import bench_of
from tests.support.flights import demo_config, demo_world
from tests.support.orbit_devices import orbit_config, orbit_world

OUTSIDE = [kind for kind in CATALOGUE.values() if kind.begin is not None and kind.where is Where.BOTH]
SECOND_NS = 1_000_000_000


IN_ORBIT = {"gps", "strings", "wide", "battery-monitor", "bus-monitor", "battery", "panels"}


@pytest.fixture(scope="module")
def orbit() -> LockStep:
    """Return the emulated devices of a satellite.

    The tests share the devices, because no fault has an effect after its end.
    """
    config = configuration.replace(orbit_config(), power=Power(battery=Battery(capacity=2.6)))
    return build_lockstep(config, orbit_world(), None, SimClock())


@pytest.fixture
def lock() -> LockStep:
    """Return the devices of a testbed with six coils, so that the faults of all coils can be injected."""
    config = demo_config(10.0)
    windings = config.coils.windings
    more = [configuration.replace(one, channels=(2 * k + 6, 2 * k + 7)) for k, one in enumerate(windings)]
    coils = configuration.replace(config.coils, windings=(*windings, *more))
    return build_lockstep(configuration.replace(config, coils=coils), demo_world(), None, SimClock())


def is_sound(lock: LockStep) -> bool:
    """Return whether no effect of any fault remains."""
    hardware, line = lock.hardware, lock.line
    assert hardware.monitor is not None
    assert hardware.camera is not None
    return (
        line.to_host.faults == SOUND
        and line.to_device.faults == SOUND
        and not line.host.unplugged
        and hardware.unit.alter is None
        and not hardware.bus._faults
        and set(hardware.bus._parts) == {hardware.pwm, hardware.monitor}
        and not hardware.monitor.frozen
        and hardware.monitor.gain == 1.0
        and set(hardware.circuit._conditions) == {CoilCondition.SOUND}
        and hardware.camera.fault == ""
        and hardware.camera.late_ns == 0
        and hardware.camera.one_of == 1
        and hardware.monitor.lag_ns == 0
    )


def orbit_is_sound(lock: LockStep) -> bool:
    """Return whether no effect of any fault remains on the emulated devices of a satellite."""
    devices, bus = lock.hardware.orbit, lock.hardware.bus
    gps, strings = devices.gps, devices.cells
    assert gps is not None
    assert strings is not None
    assert lock.gps_line is not None
    power = lock.hardware.power
    assert power is not None
    return (
        not any(rail.stuck or rail.gain != 1.0 or rail.monitor not in bus._parts for rail in power.rails)
        and (power.cells_lost, power.weakness, power.lost_panel) == (0, 1.0, None)
        and lock.gps_line.to_host.faults == SOUND
        and gps.next_event_ns() < NEVER
        and not (gps.blind or gps.frozen or gps.clock_ns or gps.shift.any())
        and not (strings.frozen or strings.dead.any() or strings.gain != 1.0)
        and set(strings.parts) <= set(bus._parts)
        and all(not camera.fault and not camera.late_ns for camera in devices.wide)
    )


@pytest.mark.parametrize(
    "kind", [kind for kind in OUTSIDE if kind.device in IN_ORBIT], ids=lambda kind: kind.name
)
def test_a_fault_of_an_orbits_device_that_is_lifted_leaves_nothing_broken(
    orbit: LockStep, kind: FaultKind
) -> None:
    begin_ns = orbit.clock.now_ns()
    put([parse(f"{kind.name} @ 0.1 for 0.3")], bench_of(orbit), begin_ns)
    assert orbit_is_sound(orbit)
    orbit.clock.sleep_until_ns(begin_ns + SECOND_NS // 5)
    assert not orbit_is_sound(orbit)
    orbit.clock.sleep_until_ns(begin_ns + SECOND_NS)
    assert orbit_is_sound(orbit)


@pytest.mark.parametrize(
    "kind", [kind for kind in OUTSIDE if kind.device not in IN_ORBIT], ids=lambda kind: kind.name
)
def test_a_fault_that_is_lifted_leaves_nothing_broken(lock: LockStep, kind: FaultKind) -> None:
    put([parse(f"{kind.name} @ 1 for 1.3")], bench_of(lock), 0)
    assert is_sound(lock)
    lock.clock.sleep_until_ns(round(1.1 * SECOND_NS))
    # The fault `imu: off` switches the whole IMU off. Momentary faults have ended before 1.1 s.
    assert kind.momentary or kind.name == "imu: off" or not is_sound(lock)
    lock.clock.sleep_until_ns(4 * SECOND_NS)
    assert is_sound(lock)


def test_two_faults_of_one_wire_last_each_its_own_time(lock: LockStep) -> None:
    faults = [parse("imu: bits (chance=0.5) @ 1 for 3"), parse("imu: delayed (delay=0.3) @ 2 for 1")]
    put(faults, bench_of(lock), 0)
    wire = lock.line.to_host
    lock.clock.sleep_until_ns(round(2.5 * SECOND_NS))
    assert wire.faults == LineFaults(flip_probability=0.5, delay_ns=300_000_000)
    lock.clock.sleep_until_ns(round(3.5 * SECOND_NS))
    assert wire.faults == LineFaults(flip_probability=0.5)


def test_an_intermittent_fault_comes_and_goes(lock: LockStep) -> None:
    put([parse("imu: intermittent (period=1, share=0.3) @ 0 for 3")], bench_of(lock), 0)
    seen = []
    for tenth in range(40):
        lock.clock.sleep_until_ns(tenth * SECOND_NS // 10 + 1)
        seen.append(lock.line.to_host.faults.silent)
    assert sum(seen[:30]) == 9
    assert not any(seen[30:])


def test_a_part_without_power_does_not_acknowledge_and_forgets(lock: LockStep) -> None:
    bus, pwm = lock.hardware.bus, lock.hardware.pwm
    bus.write_byte_data(0x40, 0x01, 0x1F)
    put([parse("pwm: off @ 1 for 1")], bench_of(lock), 0)
    lock.clock.sleep_until_ns(round(1.5 * SECOND_NS))
    with pytest.raises(OSError, match="no acknowledge"):
        bus.read_byte_data(0x40, 0x00)
    lock.clock.sleep_until_ns(3 * SECOND_NS)
    assert bus.read_byte_data(0x40, 0x01) == 0x04, "the power-on value"
    assert pwm.register(PRE_SCALE) == 0x1E


def test_a_stuck_chip_acknowledges_and_changes_nothing(lock: LockStep) -> None:
    put([parse("pwm: stuck @ 1 for 1")], bench_of(lock), 0)
    lock.clock.sleep_until_ns(round(1.5 * SECOND_NS))
    lock.hardware.bus.write_byte_data(0x40, 0x01, 0x1F)
    assert lock.hardware.bus.read_byte_data(0x40, 0x01) == 0x04


def test_an_unplugged_line_raises_where_the_driver_asks(lock: LockStep) -> None:
    put([parse("imu: unplugged @ 1 for 1")], bench_of(lock), 0)
    lock.clock.sleep_until_ns(round(1.5 * SECOND_NS))
    with pytest.raises(NotResponding):
        lock.line.host.receive()


def test_legs_that_are_stuck_drive_their_coil_and_are_braked_by_the_other(lock: LockStep) -> None:
    """A stuck leg drives its coil, and the other leg can brake the coil.

    The voltage across the coil is the difference of the voltages of both legs (Table 5.2 of the thesis).
    """
    circuit, pwm = lock.hardware.circuit, lock.hardware.pwm
    full = 3.4 / 23.0
    pwm.write(0x40, bytes([0x00, 0x20]))
    circuit.become(0, CoilCondition.A_HIGH)
    assert circuit.currents()[0] == pytest.approx(full, abs=3.5e-3)
    pwm.write(0x40, bytes([0x0A, 0x00, 0x10, 0x00, 0x00]))  # input B is full on
    assert circuit.currents()[0] == 0.0
    circuit.become(0, CoilCondition.SOUND)
    assert circuit.currents()[0] == pytest.approx(-full, abs=3.5e-3)
    circuit.become(0, CoilCondition.B_LOW)
    assert circuit.currents()[0] == 0.0
    circuit.become(0, CoilCondition.REVERSED)
    assert circuit.currents()[0] == pytest.approx(full, abs=3.5e-3)
    circuit.become(0, CoilCondition.OPEN)
    assert circuit.currents()[0] == 0.0
    now = lock.clock.now_ns()
    lock.clock.sleep_until_ns(now + 200_000_000)
    circuit.become(0, CoilCondition.SHORTED, 5.0)
    lock.clock.sleep_until_ns(now + 400_000_000)
    assert circuit.currents()[0] == 0.0
    _, drawn = circuit.mean_supply(now + 300_000_000, now + 400_000_000)
    assert drawn == pytest.approx(3.4 / 5.0)


AXES = "xyz456"
CHANCE, TURNS = "chance 0.5 1e-06..1", "period 0.5 0.05..3600 s; share 0.5 0.01..0.99"
PARAMETERS = {
    "imu: wrong": "angle 0.2 -3.14159..3.14159 rad; rate 0.05 -10..10 rad/s",
    "imu: slow": "n 8 2..1000 whole",
    "imu: delayed": "delay 0.2 0.001..60 s",
    "imu: intermittent": TURNS,
    "imu: bits": "chance 0.001 1e-06..1",
    "imu: cut": "chance 0.3 1e-06..1",
    "imu: baud": "rate 230400 9600..921600 baud",
    "imu: upset": "register drawn 6..75; bit drawn 0..175 whole",
    "magnetometer: false": "field 2e-05 1e-08..0.001 T",
    "pwm: bits": "chance 0.005 1e-06..1",
    "pwm: slow": CHANCE,
    "pwm: intermittent": TURNS,
    "pwm: delayed": "delay 0.2 0.001..60 s",
    "pwm: upset": "register drawn 0..254; bit drawn 0..7 whole",
    "monitor: bits": "chance 0.005 1e-06..1",
    "monitor: slow": CHANCE,
    "monitor: intermittent": TURNS,
    "monitor: delayed": "delay 2 0.001..60 s",
    "monitor: wrong": "gain 2 0..10",
    "monitor: upset": "register drawn 0..5; bit drawn 0..15 whole",
    "bus: nack": CHANCE,
    "bus: intermittent": TURNS,
    **{f"coil-{axis}: shorted": "ohm 5 0.1..1000 ohm" for axis in AXES},
    "camera: slow": "n 3 2..1000 whole",
    "camera: delayed": "delay 3 0.001..60 s",
    "camera: intermittent": "period 6 0.05..3600 s; share 0.5 0.01..0.99",
    "gps: false": "distance 20000 1..2e+07 m",
    "gps: clock": "seconds 180 -86400..86400 s",
    "gps: bits": "chance 0.001 1e-06..1",
    "gps: delayed": "delay 2 0.001..60 s",
    "gps: intermittent": TURNS,
    "battery-monitor: wrong": "gain 0.5 0..10",
    "bus-monitor: wrong": "gain 0.5 0..10",
    "battery: weak": "factor 4 1..100",
    "panels: lost": "panel 1 0..32 whole",
    "strings: dead": "string 1 0..4 whole",
    "strings: wrong": "gain 0.5 0..10",
    **{
        f"wide: {kind}": "camera 0 0..6 whole"
        for kind in ("off", "black", "saturated", "blinded", "frozen", "garbage", "wrong")
    },
    "wide: delayed": "camera 0 0..6 whole; delay 3 0.001..60 s",
    "wide: intermittent": "camera 0 0..6 whole; period 6 0.05..3600 s; share 0.5 0.01..0.99",
    "planner: slow": "delay 1.5 0.001..60 s",
    "vision: slow": "delay 1.5 0.001..60 s",
    "clock: stepped": "by 3600 -3.2e+08..3.2e+08 s",
    "config: corrupted": "bytes 3 1..10000 whole",
}
PLAIN = """
imu: off, imu: silent, imu: unplugged, imu: stuck, imu: gyro-dead, imu: garbage, imu: reset,
magnetometer: stuck, magnetometer: saturated, pwm: off, pwm: nack, pwm: garbage, pwm: brown-out, pwm: stuck,
pwm: wrong,
monitor: off, monitor: nack, monitor: garbage, monitor: brown-out, monitor: stuck, bus: off,
bus: arbitration, bus: hang, camera: off, camera: black, camera: saturated, camera: blinded, camera: frozen,
camera: torn, camera: garbage, camera: wrong, gps: off, gps: silent, gps: no-fix, gps: stuck, gps: garbage,
battery-monitor: off, battery-monitor: stuck, bus-monitor: off, bus-monitor: stuck, battery: cell-lost,
strings: off, strings: stuck, strings: garbage, planner: nan, planner: exception, planner: endless,
planner: killed, vision: nan, vision: exception, vision: endless, vision: killed, process: killed,
process: stopped, disk: full, disk: failing
"""
MOMENTARY = {
    "imu: reset", "imu: baud", "imu: upset", "pwm: brown-out", "pwm: wrong", "pwm: upset",
    "monitor: brown-out", "monitor: upset", "process: killed", "config: corrupted",
}  # fmt: skip
TOGETHER = {
    "imu": "silent garbage slow delayed intermittent bits cut upset",
    "pwm": "nack slow intermittent brown-out wrong upset",
    "monitor": "nack slow intermittent brown-out upset",
    "bus": "off nack arbitration hang intermittent",
    "gps": "silent clock garbage bits delayed intermittent",
}
"""Types of fault that may be active together with other faults of the same device."""


def test_the_faults_are_those_of_the_table() -> None:
    coils = {f"coil-{axis}: {kind}" for axis in AXES for kind in ("open", "shorted", "reversed")}
    bridges = {f"bridge-{axis}: {leg}-{level}" for axis in AXES for leg in "ab" for level in ("high", "low")}
    plain = {" ".join(name.split()) for name in PLAIN.split(",")}
    assert set(CATALOGUE) == plain | set(PARAMETERS) | coils | bridges


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_fault_has_the_parameters_of_the_table(name: str) -> None:
    rows = []
    for key, parameter in CATALOGUE[name].parameters.items():
        default = "drawn" if parameter.default is None else f"{parameter.default:g}"
        words = [key, default, f"{parameter.low:g}..{parameter.high:g}", parameter.unit]
        rows.append(" ".join([word for word in words if word] + ["whole"] * parameter.whole))
    assert "; ".join(rows) == PARAMETERS.get(name, "")


def test_the_faults_without_a_duration_are_those_of_the_table() -> None:
    assert {name for name, kind in CATALOGUE.items() if kind.momentary} == MOMENTARY


def test_the_faults_that_may_come_together_are_those_of_the_table() -> None:
    expected = {f"{device}: {kind}" for device, kinds in TOGETHER.items() for kind in kinds.split()}
    assert {name for name, kind in CATALOGUE.items() if kind.adds} == expected


def test_some_faults_need_a_process_or_a_command_line() -> None:
    assert {name: kind.where for name, kind in CATALOGUE.items() if kind.where is not Where.BOTH} == {
        "process: killed": Where.REALTIME,
        "process: stopped": Where.REALTIME,
        "config: corrupted": Where.COMMAND_LINE,
    }


def test_the_choices_are_registers_and_speeds_that_exist() -> None:
    assert list(CATALOGUE["imu: upset"].parameters["register"].choices) == [6, 7, 75]
    assert list(CATALOGUE["monitor: upset"].parameters["register"].choices) == [0, 5]
    # Registers of the PCA9685: MODE1, MODE2, four registers of each of the 16 channels from 0x06 on, and
    # PRE_SCALE.
    assert list(CATALOGUE["pwm: upset"].parameters["register"].choices) == [0, 1, *range(6, 70), 254]
    speeds = [9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600]
    assert list(CATALOGUE["imu: baud"].parameters["rate"].choices) == speeds


def test_the_largest_angle_is_half_a_turn() -> None:
    assert CATALOGUE["imu: wrong"].parameters["angle"].high == math.pi
