"""Tests that contradictory values are refused, and that the link accepts only configured addresses."""

from __future__ import annotations

import socket
from ipaddress import IPv4Network
from pathlib import Path

import numpy as np
import pytest

from flight.app.devices import check_settings
from flight.link.commands import CommandPacker, Ping, open_udp
from flight.schema.bodies import OrbitConfig, as_orbit
from flight.schema.document import ConfigError
from flight.schema.reader import load, parse, peer_networks, simulation_section
from sim_hal.settings import Simulation
from tests.support.flights import CONFIG

ORBIT = CONFIG.parent / "orbit.yaml"


def networks(lines: str, commands: str = "{socket: /run/x}") -> list[str]:
    text = CONFIG.read_text(encoding="utf-8")
    link = parse(f"{text}\ncommands: {commands}\nlink: {{keys: /k, {lines}}}\n").link
    assert link is not None
    return [str(network) for network in peer_networks(link)]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("serial: {device: /dev/ttyS0}", []),
        ("udp: '127.0.0.3:5000'", ["127.0.0.0/8"]),
        ("udp: '10.20.30.40:5000'", ["10.20.30.0/24"]),
        ("udp: '10.20.30.40:5000', peers: [10.20.30.7]", ["10.20.30.7/32"]),
        ("tcp: 'board:5000', peers: [10.20.0.0/16, 127.0.0.1]", ["10.20.0.0/16", "127.0.0.1/32"]),
        ("kiss: 'localhost:8001'", ["127.0.0.0/8"]),
        ("udp: '10.1.1.1:5', peers: [10.2.0.1], kiss: '10.3.3.3:8001'", ["10.2.0.1/32", "10.3.3.0/24"]),
    ],
)
def test_the_default_peers_are_the_network_of_the_address(lines: str, expected: list[str]) -> None:
    assert networks(lines) == expected


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        (
            "udp: '0.0.0.0:5000'",
            r"`link.udp` 0\.0\.0\.0 accepts every network: list the permitted senders",
        ),
        ("tcp: 'board:5000'", r"`link.tcp` board is not an IPv4 address: list the permitted senders"),
        ("udp: '10.0.0.1:5000', peers: [10.0.0.5/24]", r"`link.peers` 10\.0\.0\.5/24 has host bits"),
        ("udp: '10.0.0.1:5000', peers: [10.0.0.500]", "`link.peers` .*not permitted"),
        ("udp: '10.0.0.1:5000', peers: [ground]", "`link.peers"),
        ("udp: '10.0.0.1:5000', peers: []", "`link.peers"),
        ("spacecraft: 5", "`link` has no communication line"),
        ("tcp: '127.0.0.1:5', telemetry_to: '127.0.0.1:6'", "`link.telemetry_to` needs `link.udp`"),
        (
            "udp: '127.0.0.1:5', telemetry_to: 'ground.example:6'",
            "`link.telemetry_to` ground.example is not an IPv4 address",
        ),
        (
            "tcp: '127.0.0.1:5', frame_bytes: 1116, coding: {reed_solomon: 5}",
            r"is 1116: must be a multiple of `link.coding.reed_solomon` \(5\), at most 1115",
        ),
        ("tcp: '127.0.0.1:5', frame_bytes: 224, coding: {reed_solomon: 1}", "at most 223"),
        ("tcp: '127.0.0.1:5', coding: {reed_solomon: 6}", "`link.coding.reed_solomon"),
        ("tcp: '127.0.0.1:5', frame_bytes: 127", "`link.frame_bytes"),
        ("tcp: '127.0.0.1:5', command_frame_bytes: 1025", "`link.command_frame_bytes"),
        ("tcp: '127.0.0.1:5', rate: 1000, idle_rate: 1001", "`link.idle_rate` is 1001: must not be above"),
        ("kiss: '0.0.0.0:8001'", "`link.kiss` 0.0.0.0"),
        (
            "serial: {device: /dev/ttyS1}, call_signs: [A, B]",
            "`link.call_signs` needs `link.kiss` or `link.serial.kiss`",
        ),
        ("kiss: '127.0.0.1:8001', call_signs: [OK0GND, OK0SAT-16]", "`link.call_signs"),
    ],
)
def test_impossible_lines_are_refused_with_the_remedy(lines: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        networks(lines)


@pytest.mark.parametrize("address", ["192.168.7.2:5000", "0.0.0.0:5000", "board:5000"])
def test_unprotected_commands_from_other_machines_are_refused(address: str) -> None:
    with pytest.raises(
        ConfigError, match=r"`commands.udp` .* accepts unprotected commands from other machines"
    ):
        networks("udp: '10.0.0.1:5000'", f"{{socket: /run/x, udp: '{address}'}}")


def test_a_link_needs_the_flights_socket() -> None:
    with pytest.raises(ConfigError, match=r"`link` needs `commands.socket`"):
        networks("udp: '10.0.0.1:5000'", "{}")


def test_a_datagram_from_an_unknown_address_is_ignored() -> None:
    ping = CommandPacker().pack(Ping(), 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for peers, heard in ((["127.0.0.0/8"], [ping]), (["192.0.2.0/24"], [])):
            channel = open_udp("127.0.0.1:0", [IPv4Network(peer) for peer in peers])
            sender.sendto(ping, channel._socket.getsockname())
            assert [data for data, _ in channel.poll()] == heard
            channel.close()


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("channel: 1}", "channel: 0}", r"`solar_strings.strings\[1\].channel` is 0: this ADC channel"),
        (
            "channel: 0}",
            "channel: 0, address: 0x40}",
            r"strings\[0\].address` is 0x40, which `coils.address` also uses",
        ),
        (
            "  baud_rate: 115200",
            "  calibration: {gyro_matrix: [[1, 0.4, 0], [0, 1, 0], [0, 0, 1]]}\n  baud_rate: 115200",
            r"calibration.gyro_matrix` differs from the identity matrix by 0.4",
        ),
        ("{normal: [1.0,", "{normal: [1.1,", r"strings\[0\].normal` has length 1.1: give a unit vector"),
        (
            "[0.0, 0.0, 0.0, 1.0], columns",
            "[0.0, 0.1, 0.0, 1.0], columns",
            r"wide_cameras\[4\].mounting` has",
        ),
        (
            "period: 10.0}\n\n",
            "period: 10.0, bits: 9}\n\n",
            r"wide_cameras\[5\].bits` is 9: must be equal for all `wide_cameras`.*8",
        ),
        (
            "period: 10.0}\n\n",
            "period: 10.0, structure: [[[0, 0], [400, 0], [400, 511], [0, 511]]]}\n\n",
            r"wide_cameras\[5\].structure` is refused: structure covers 78 % of the image: at most half",
        ),
        (
            "  inertia: [1.10e-3, 1.05e-3, 0.99e-3]",
            "  inertia: [1.10e-3, 1.05e-3, 2.99e-3]",
            r"`craft.inertia` has the principal moments 0.00105, 0.0011, 0.00299: the largest",
        ),
        (
            "  inertia: [1.10e-3, 1.05e-3, 0.99e-3]",
            "  inertia: [1.10e-3, 1.05e-3, -0.99e-3]",
            "`craft.inertia` has the principal moments .*: all must be positive",
        ),
        (
            "  inertia: [1.10e-3, 1.05e-3, 0.99e-3]",
            "  inertia: [1.10e-3, 1.05e-3, [0, 0, 0.99e-3]]",
            "`craft.inertia` mixes numbers and rows: give three moments, or three rows",
        ),
        (
            "  inertia: [1.10e-3, 1.05e-3, 0.99e-3]",
            "  inertia: [[1.10e-3, 1e-5, 0], [-1e-5, 1.05e-3, 0], [0, 0, 0.99e-3]]",
            "`craft.inertia` is not symmetric: row 1, column 2 is 1e-05, and row 2, column 1 is -1e-05: give",
        ),
        (
            "  star_tracker: {}",
            "  star_tracker: {}\n  objects: {needed: 7}",
            "`camera.objects.needed` is 7: must be at most `within`",
        ),
        (
            "  star_tracker: {}",
            "  star_tracker: {}\n  device: {driver: v4l2, pixel_format: Y10}",
            "`camera.bits` is 16: pixels of Y10 have 10 bits$",
        ),
        (
            "duration:",
            "telemetry: {segment_bytes: 9000, budget_bytes: 17999}\nduration:",
            "at least twice `telemetry.segment_bytes`",
        ),
        (
            "duration:",
            "telemetry: {segment_bytes: 4096, budget_bytes: 40964096}\nduration:",
            "a log has at most 10000 segments: give a larger `telemetry.segment_bytes`",
        ),
        (
            "duration:",
            "telemetry: {segment_bytes: 9000, budget_bytes: 20000, archive_bytes: 59999}\nduration:",
            "`telemetry.archive_bytes` is 59999: must be at least 3 times `telemetry.budget_bytes`",
        ),
    ],
)
def test_values_that_contradict_each_other_are_refused(right: str, wrong: str, complaint: str) -> None:
    text = ORBIT.read_text(encoding="utf-8")
    assert right in text
    parse(text)
    with pytest.raises(ConfigError, match=complaint):
        parse(text.replace(right, wrong, 1))


def test_the_inertia_is_a_tensor_or_its_diagonal() -> None:
    text = ORBIT.read_text(encoding="utf-8")
    moments = "[1.10e-3, 1.05e-3, 0.99e-3]"
    np.testing.assert_array_equal(
        as_orbit(parse(text)).craft.inertia_matrix(), np.diag([1.10e-3, 1.05e-3, 0.99e-3])
    )
    tensor = "[[1.10e-3, 1e-5, 0], [1e-5, 1.05e-3, 0], [0, 0, 0.99e-3]]"
    np.testing.assert_array_equal(
        as_orbit(parse(text.replace(moments, tensor))).craft.inertia_matrix(),
        [[1.10e-3, 1e-5, 0.0], [1e-5, 1.05e-3, 0.0], [0.0, 0.0, 0.99e-3]],
    )


@pytest.mark.parametrize(
    "right",
    [
        "telemetry: {segment_bytes: 9000, budget_bytes: 18000}",
        "telemetry: {segment_bytes: 4096, budget_bytes: 40960000, archive_bytes: 122880000}",
        "commands: {udp: 'localhost:5000'}",
        "commands: {udp: '127.1.2.3:5000'}",
    ],
)
def test_values_at_a_limit_are_accepted(right: str) -> None:
    parse(ORBIT.read_text(encoding="utf-8").replace("duration:", f"{right}\nduration:", 1))


@pytest.mark.parametrize("name", ["sun", "earth", "moon"])
def test_a_cone_that_reaches_into_the_field_of_view_is_refused(name: str) -> None:
    """An exclusion cone must not reach into the field of view.

    The corner of a square field of 20 deg is atan(sqrt(2) tan(10 deg)) = 14.0 deg from the boresight.
    """
    text = ORBIT.read_text(encoding="utf-8")
    start = text.index("  cones: {")
    line = text[start : text.index("\n", start)]
    parse(text.replace(line, f"  cones: {{{name}_deg: 14.1}}"))
    with pytest.raises(
        ConfigError, match=rf"`pointing\.cones\.{name}_deg` is 13\.9: must cover the corner .* 14\.0 deg"
    ):
        parse(text.replace(line, f"  cones: {{{name}_deg: 13.9}}"))


@pytest.mark.parametrize("path", sorted(CONFIG.parent.glob("orbit*.yaml")), ids=lambda path: path.stem)
def test_the_cones_of_the_shipped_satellites_are_wider_than_the_baffle_of_the_simulated_camera(
    path: Path,
) -> None:
    flown = load(path)
    assert isinstance(flown, OrbitConfig)
    section = simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    assert section is not None
    sky, cones = section.sky, flown.pointing.cones
    assert cones.sun_deg is None or cones.sun_deg > sky.sun_exclusion_deg
    assert cones.earth_deg is None or cones.earth_deg > sky.earth_exclusion_deg


@pytest.mark.parametrize(
    ("section", "complaint"),
    [
        ("{battery: {capacity: -1.0}}", r"`power.battery.capacity`"),
        ("{battery: {capacity: 2.6, cells: 4}}", r"`power.battery.cells`"),
        ("{battery: {capacity: 2.6, open_circuit: [3.0, 3.5, 3.4]}}", r"open_circuit` must rise"),
        ("{battery: {capacity: 2.6}, battery_monitor: {address: 0x45}}", r"battery_monitor.address` is 0x45"),
        ("{battery: {capacity: 2.6}, bus_monitor: {address: 0x41}}", r"bus_monitor.address` is 0x41"),
        ("{battery: {capacity: 2.6}, bus_monitor: {address: 0x49}}", r"bus_monitor.address` is 0x49"),
        ("{battery: {capacity: 2.6}, low_battery: {critical: 0.35}}", r"has 0.35, 0.3, 0.4.* rising order"),
        ("{battery: {capacity: 2.6}, low_battery: {low: 0.95}}", r"low_battery.low` is 0.95: with the hyst"),
        ("{battery: {capacity: 2.6}, low_battery: {camera_period: 4.0}}", r"camera_period` is 4 s: must be"),
    ],
)
def test_an_impossible_power_system_is_refused(section: str, complaint: str) -> None:
    text = (CONFIG.parent / "orbit.yaml").read_text(encoding="utf-8")
    assert parse(f"power: {{battery: {{capacity: 2.6}}}}\n{text}").power is not None
    with pytest.raises(ConfigError, match=complaint):
        parse(f"power: {section}\n{text}")


def test_a_current_beyond_the_range_of_the_power_monitor_is_refused() -> None:
    text = (CONFIG.parent / "orbit.yaml").read_text(encoding="utf-8")
    monitor = "battery_monitor: {address: 0x41, shunt: 0.2, maximum_current: 2.0}"
    config = parse(f"power: {{battery: {{capacity: 2.6}}, {monitor}}}\n{text}")
    with pytest.raises(ConfigError, match=r"power.battery_monitor.maximum_current.*0 to 1.6 A"):
        check_settings(config)


@pytest.mark.parametrize(
    ("measured", "refused"),
    [("gyro", True), ("gyro acceleration", False), ("acceleration", False), ("", False)],
)
def test_a_gyro_on_the_testbed_needs_an_accelerometer(measured: str, refused: bool) -> None:
    """Gravity and magnetic field give the angle about the thread; without a gyro, the field alone does."""
    axes = ", ".join(f"{quantity}: [x, y, z]" for quantity in ["magnetic", *measured.split()])
    sensors = f"sensors: [{{part: lis3mdl, address: 0x1e, measures: {{{axes}}}}}]"
    text = f"extends: step_demo\ninertial_unit: {{driver: sensors, {sensors}}}\n"
    if not refused:
        parse(text)
        return
    with pytest.raises(ConfigError, match="measure the rate but not the acceleration"):
        parse(text)
