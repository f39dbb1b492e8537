"""Print the drop-in that a configuration needs for a unit: its devices, network and bus.

Run by install.sh with the installed Python: board_dropin.py [--safe | --link] CONFIG; with --safe for
knightcube-safe.service, with --link for knightcube-link.service (nothing where there is no link), else for
knightcube.service. Exit status 2, and one line, for a wrong configuration.
"""

from __future__ import annotations

import os
import stat
import string
import sys
from collections.abc import Sequence
from ipaddress import IPv4Network
from pathlib import Path

from flight.schema.consistency import LOOPBACK, peer_networks
from flight.schema.devices import V4l2Device
from flight.schema.reader import load
from flight.schema.sections import Config
from hal.buses.i2c_bus import device_file
from knightcube.errors import UsageError

SERIAL, VIDEO, I2C = ("ttyUSB", "ttyACM"), ("video4linux",), ()
"""Driver classes of the devices that may be plugged in after the start, by kind."""


def dropin(config: Config) -> str:
    """Return the drop-in of the flight's unit."""
    lines = []
    if config.simulation is None:
        awaited = [device_unit(path) for path, _ in _nodes(config)]
        lines += ["[Unit]", *(f"{word}={unit}" for unit in awaited for word in ("Wants", "After"))]
    lines += ["[Service]", *_devices(config)]
    if config.commands.udp is not None:  # a bench, on this machine alone
        lines += _network([LOOPBACK])
    return _text(lines)


def safe_dropin(config: Config) -> str:
    """Return the drop-in of the safe state's unit, which accesses the coils and the command socket."""
    lines = ["[Service]", *(_bus(config) if config.simulation is None else [])]
    if config.commands.socket is not None:
        lines.append(f'Environment="KNIGHTCUBE_COMMANDS={config.commands.socket}"')
    return _text(lines)


def link_dropin(config: Config, root: Path = Path("/")) -> str:
    """Return the drop-in of the link's unit, empty where the configuration has no link."""
    link = config.link
    if link is None:
        return ""
    lines = ["[Service]", f"ReadWritePaths=-{Path(link.keys).absolute()}"]
    if peers := peer_networks(link):
        lines += _network(peers)
    if link.serial is not None:
        lines += ["SupplementaryGroups=dialout", *_line(link.serial.device, root)]
    else:
        lines.append("PrivateDevices=yes")
    return _text(lines)


def _line(device: str, root: Path) -> list[str]:
    """Return the lines that open a serial line: one on the board alone in a /dev of the unit's own.

    One that is plugged in, or not there yet, may return as a new node, which such a /dev would not show.
    """
    opened = allowed(device, SERIAL, root)
    return opened if len(opened) > 1 else [*opened, "PrivateDevices=yes", f"BindPaths={device}"]


def device_unit(path: str) -> str:
    """Return the name of systemd's unit of a device file (systemd.unit(5), "string escaping")."""
    kept = {ord(letter) for letter in string.ascii_letters + string.digits + ":_."}
    name = path.strip("/").encode()
    escaped = ["-" if byte == ord("/") else chr(byte) if byte in kept else f"\\x{byte:02x}" for byte in name]
    return "".join(escaped) + ".device"


def allowed(path: str, plugged: tuple[str, ...], root: Path = Path("/")) -> list[str]:
    """Return the DeviceAllow lines of a device file, a udev name or the node itself.

    systemd resolves a file to one device number when the unit starts. A USB device may return under another
    number, ttyUSB1 for ttyUSB0, so its driver's class is allowed; a device that does not exist yet is allowed
    by the classes `plugged`. `root` holds proc and sys.
    """
    try:
        mode, number = (found := os.stat(path)).st_mode, found.st_rdev
    except OSError:
        classes = plugged
    else:
        of_device = root / f"sys/dev/char/{os.major(number)}:{os.minor(number)}"
        on_usb = stat.S_ISCHR(mode) and any(part.startswith("usb") for part in of_device.resolve().parts)
        classes = _driver_classes(os.major(number), root) if on_usb else ()
    return [f"DeviceAllow={what} rw" for what in (path, *(f"char-{name}" for name in classes))]


def _driver_classes(major: int, root: Path) -> tuple[str, ...]:
    """Return the driver name of a character device from /proc/devices."""
    listed = (root / "proc/devices").read_text(encoding="ascii").partition("Block devices:")[0]
    pairs = (words for line in listed.splitlines() if len(words := line.split()) == 2)
    return tuple(name for number, name in pairs if number == str(major))


def _network(peers: Sequence[IPv4Network]) -> list[str]:
    """Return the lines that open the network; IPAddressDeny=any of the unit stays in force for all others."""
    opened = ["PrivateNetwork=no", "RestrictAddressFamilies=AF_INET"]
    return [*opened, *(f"IPAddressAllow={peer}" for peer in peers)]


def _text(lines: list[str]) -> str:
    first = "# Made by install.sh from the configuration: run it again when devices or network change there."
    return "\n".join([first, *lines]) + "\n"


def _nodes(config: Config) -> list[tuple[str, tuple[str, ...]]]:
    """Return the files of the configured devices, each with the classes in which it may appear."""
    nodes = [(device_file(config.coils.bus), I2C), (config.inertial_unit.device, SERIAL)]
    camera = config.camera.device if config.camera is not None else None
    return [*nodes, (camera.path, VIDEO)] if isinstance(camera, V4l2Device) else nodes


def _devices(config: Config) -> list[str]:
    """Return the lines that allow the real devices."""
    if config.simulation is not None:
        return []
    lines = _bus(config)
    for path, plugged in _nodes(config)[1:]:
        lines += allowed(path, plugged)
    camera = config.camera.device if config.camera is not None else None
    if camera is not None and not isinstance(camera, V4l2Device):
        # Aravis talks to USB3 Vision cameras by libusb, which asks udev for them.
        lines += ["DeviceAllow=char-usb_device rw", "RestrictAddressFamilies=AF_NETLINK"]
    return lines


def _bus(config: Config) -> list[str]:
    """Return the lines that `coils-off` needs."""
    i2c = device_file(config.coils.bus)
    return [
        f"Environment=KNIGHTCUBE_I2C={i2c} KNIGHTCUBE_PWM=0x{config.coils.address:02x}",
        *allowed(i2c, I2C),
    ]


def main(words: list[str]) -> int:
    """Print the drop-in of a configuration."""
    make = {"--safe": safe_dropin, "--link": link_dropin}.get(words[0], dropin)
    try:
        sys.stdout.write(make(load(Path(words[-1]))))
    except UsageError as error:
        sys.stderr.write(f"install: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
