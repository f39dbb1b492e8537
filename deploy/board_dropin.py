"""Makes the systemd drop-ins that give the services access to the devices and networks of a configuration.

The script install.sh runs board_dropin.py CONFIG FOLDER with the installed Python. In FOLDER, the file
`flight` is the drop-in of knightcube.service, `safe` that of knightcube-safe.service, and `link` that of
knightcube-link.service. The file `link` is empty if the configuration has no link. The file `tracker` is
written if the star tracker needs the default sky index. Without FOLDER, the script prints the drop-in of
knightcube.service. For an invalid configuration, the script prints one line and exits with status 2.
"""

from __future__ import annotations

import os
import re
import stat
import string
import sys
from collections.abc import Sequence
from ipaddress import IPv4Network
from pathlib import Path
from typing import Any

from flight.schema.devices import AravisDevice, driver_of, fitted_devices
from flight.schema.document import ConfigError, read_document, read_text
from flight.schema.reader import LOOPBACK, load, peer_networks
from flight.schema.sections import Config
from hal.buses.linux_wires import device_file
from hal.interfaces.guardian import CoilReach
from knightcube.errors import UsageError

SERIAL, VIDEO, I2C = ("ttyUSB", "ttyACM"), ("video4linux",), ()
"""Driver classes of pluggable devices: serial lines, video devices, and no class for I2C buses."""
_CLASSES = {"inertial_unit": SERIAL, "gps": SERIAL, "camera": VIDEO}
"""Driver classes of the devices, by section of the configuration."""
_PLAIN = re.compile(r"(?!.*/\.\.(/|$))/[A-Za-z0-9_./:+,@=-]+")
"""Absolute paths without `..`, a line break or another character that has a meaning in a unit file."""


def dropin(config: Config) -> str:
    """Return the drop-in of knightcube.service, which runs the flight software."""
    lines = []
    if config.simulation is None:
        awaited = [device_unit(path) for path, _ in _nodes(config)]
        lines += ["[Unit]", *(f"{word}={unit}" for unit in awaited for word in ("Wants", "After"))]
    lines += ["[Service]", *_devices(config)]
    if config.simulation is None and config.body != "testbed":
        lines.append("Restart=always")  # a satellite's flight software starts again after each flight
    if config.commands.udp is not None:  # UDP commands are accepted only from this machine
        lines += _network([LOOPBACK])
    return _text(lines)


def safe_dropin(config: Config) -> str:
    """Return the drop-in of knightcube-safe.service, which accesses the coils and the command socket."""
    lines = ["[Service]", *(_bus(config) if config.simulation is None else [])]
    if config.commands.socket is not None:
        lines.append(f'Environment="KNIGHTCUBE_COMMANDS={plain(config.commands.socket)}"')
    return _text(lines)


def link_dropin(config: Config, root: Path = Path("/")) -> str:
    """Return the drop-in of knightcube-link.service, or an empty text if the configuration has no link."""
    link = config.link
    if link is None:
        return ""
    lines = ["[Service]", f"ReadWritePaths=-{plain(link.keys)}"]
    if peers := peer_networks(link):
        lines += _network(peers)
    if link.serial is not None:
        lines += ["SupplementaryGroups=dialout", *_line(link.serial.device, root)]
    else:
        lines.append("PrivateDevices=yes")
    return _text(lines)


def _line(device: str, root: Path) -> list[str]:
    """Return the settings that give a service access to a serial line.

    If the serial line is built into the board, the service gets a private /dev that contains only this line.
    A pluggable or missing device may appear later as a new device file, which a private /dev would not
    contain. BindPaths would split a path with a colon into two paths.
    """
    opened, private = allowed(device, SERIAL, root), ["PrivateDevices=yes", f"BindPaths={device}"]
    return opened if len(opened) > 1 or ":" in device else [*opened, *private]


def plain(path: str) -> str:
    """Check a path of the configuration for use in a unit file, and return the path.

    Raises UsageError for a relative path, and for a path that could change the meaning of the unit file.
    """
    if not _PLAIN.fullmatch(path):
        form = "be absolute, without `..`, of letters, digits and _ . / : + , @ = -"
        raise UsageError(f"{path!r}: a path on the board must {form}")
    return path


def device_unit(path: str) -> str:
    """Return the name of the systemd device unit for a device file (systemd.unit(5), "string escaping")."""
    kept = {ord(letter) for letter in string.ascii_letters + string.digits + ":_."}
    name = path.strip("/").encode()
    escaped = ["-" if byte == ord("/") else chr(byte) if byte in kept else f"\\x{byte:02x}" for byte in name]
    return "".join(escaped) + ".device"


def allowed(path: str, plugged: tuple[str, ...], root: Path = Path("/")) -> list[str]:
    """Return the DeviceAllow lines for a device file, which may be a symbolic link made by udev.

    systemd resolves a file to one device number when the service starts. A USB device may reconnect under a
    different number, such as ttyUSB1 instead of ttyUSB0, so the class of its driver is permitted. If the
    device does not exist yet, its driver is not known, so all driver classes in `plugged` are permitted. The
    folder `root` contains the file systems proc and sys.
    """
    try:
        mode, number = (found := os.stat(path)).st_mode, found.st_rdev
    except OSError:
        classes = plugged
    else:
        of_device = root / f"sys/dev/char/{os.major(number)}:{os.minor(number)}"
        on_usb = stat.S_ISCHR(mode) and any(part.startswith("usb") for part in of_device.resolve().parts)
        classes = _driver_classes(os.major(number), root) if on_usb else ()
    return [f"DeviceAllow={what} rw" for what in (plain(path), *(f"char-{name}" for name in classes))]


def _driver_classes(major: int, root: Path) -> tuple[str, ...]:
    """Return the names of the character device drivers with a major number, from /proc/devices."""
    listed = (root / "proc/devices").read_text(encoding="ascii").partition("Block devices:")[0]
    pairs = (words for line in listed.splitlines() if len(words := line.split()) == 2)
    return tuple(name for number, name in pairs if number == str(major))


def _network(peers: Sequence[IPv4Network]) -> list[str]:
    """Return the settings that permit traffic to the hosts `peers`.

    The service file denies other addresses.
    """
    opened = ["PrivateNetwork=no", "RestrictAddressFamilies=AF_INET"]
    return [*opened, *(f"IPAddressAllow={peer}" for peer in peers)]


def _text(lines: list[str]) -> str:
    first = (
        "# Written by install.sh from the configuration: run it again after a change of devices or network."
    )
    return "\n".join([first, *lines]) + "\n"


def _devices_of(config: Config) -> list[tuple[str, Any]]:
    """Return the kind and the section of each configured device, beginning with the coils."""
    named = [("coils", config.coils), *((kind, section) for _, kind, section in fitted_devices(config))]
    cameras = (config.camera, *config.wide_cameras)
    return named + [("camera", camera) for camera in cameras if camera is not None]


def _nodes(config: Config) -> list[tuple[str, tuple[str, ...]]]:
    """Return the device files of the configured devices, each with its permitted driver classes."""
    nodes: dict[str, tuple[str, ...]] = {}
    for kind, section in _devices_of(config):
        driver = driver_of(kind, section.device if kind == "camera" else section)
        for file in driver.files(section):
            nodes.setdefault(file, _CLASSES.get(kind, ()))
    return list(nodes.items())


def _devices(config: Config) -> list[str]:
    """Return the settings that allow access to the real devices; the list is empty for a simulation."""
    if config.simulation is not None:
        return []
    lines, (coils, _) = _bus(config), _nodes(config)[0]
    for path, plugged in _nodes(config):
        lines += allowed(path, plugged) if path != coils else []
    if any(
        isinstance(camera.device, AravisDevice) for kind, camera in _devices_of(config) if kind == "camera"
    ):
        # Aravis accesses USB3 Vision cameras through libusb, which finds the cameras through udev.
        lines += ["DeviceAllow=char-usb_device rw", "RestrictAddressFamilies=AF_NETLINK"]
    return lines


def _bus(config: Config) -> list[str]:
    """Return the settings that allow access to the I2C bus of the coils."""
    i2c, writes = device_file(config.coils.bus), tuple(driver_of("coils", config.coils).off(config.coils))
    words = " ".join(CoilReach("", i2c, writes).words)
    # The script `coils-off` itself appends the last two words for a PCA9685.
    pwm = f"KNIGHTCUBE_PWM={words.removesuffix(' 0xfd 0x10')}"
    return [
        f"Environment=KNIGHTCUBE_I2C={i2c} {pwm if ' ' not in pwm else chr(34) + pwm + chr(34)}",
        *allowed(i2c, I2C),
    ]


def check_single(path: Path) -> None:
    """Raise ConfigError if a configuration extends another file, which the file's checksum does not cover."""
    if len(read_document(read_text(path), str(path)).chain) > 1:
        problem = "the checksum covers a single file: merge the files by `knightcube check FILE --merged NEW`"
        raise ConfigError(str(path), f"`extends` cannot be used on a board: {problem}")


def main(words: list[str]) -> int:
    """Make the drop-ins for the configuration file in the arguments, and return the exit status."""
    from flight.app.cli.run import check_values  # noqa: PLC0415 - open_bundle.py does not need the flight,
    from flight.app.flight import placing  # noqa: PLC0415 - which is slow to load

    if not 1 <= len(words) <= 2 or words[0].startswith("-"):
        sys.stderr.write("usage: board_dropin.py CONFIG [FOLDER]\n")
        return 2
    path, folder = Path(words[0]), Path(words[1]) if words[1:] else None
    if folder is not None and not folder.is_dir():
        sys.stderr.write(f"install: {folder}: no such folder: make it, or give another one\n")
        return 2
    try:
        check_single(path)
        config = load(path)
        with placing(read_text(path), str(path)):
            check_values(config)
        if folder is None:
            sys.stdout.write(dropin(config))
        else:
            for name, make in (("flight", dropin), ("safe", safe_dropin), ("link", link_dropin)):
                (folder / name).write_text(make(config), encoding="utf-8")
            tracker = config.camera.star_tracker if config.camera is not None else None
            if tracker is not None and tracker.index is None:
                (folder / "tracker").touch()
    except UsageError as error:
        sys.stderr.write(f"install: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
