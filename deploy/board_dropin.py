"""Print the drop-in for knightcube.service that a configuration needs: its devices, its network, its bus.

Run by install.sh with the installed Python: board_dropin.py CONFIG. Exit status 2, and one line, for a
configuration that is wrong.
"""

from __future__ import annotations

import sys
from pathlib import Path

from flight.config import load
from flight.errors import UsageError
from flight.settings import Config, V4l2Device


def dropin(config: Config) -> str:
    """Return the drop-in's text."""
    lines = [
        "# Made by install.sh from the configuration: run it again when devices or network change there."
    ]
    if config.simulation is None:
        lines += _devices(config)
    else:
        lines.append("[Service]")
    if config.commands.udp is not None:
        lines += ["PrivateNetwork=no", "IPAddressDeny=", "RestrictAddressFamilies=AF_INET"]
    return "\n".join(lines) + "\n"


def _devices(config: Config) -> list[str]:
    """Return what real devices need: to be waited for, and to be let through."""
    i2c, unit = f"/dev/i2c-{config.coils.bus}", config.inertial_unit.device
    # systemd's own escape of a path: what waits for udev's name to appear is a unit of that name.
    awaited = unit.strip("/").replace("-", r"\x2d").replace("/", "-") + ".device"
    lines = [
        "[Unit]",
        f"Wants={awaited}",
        f"After={awaited}",
        "[Service]",
        f"Environment=KNIGHTCUBE_I2C={i2c} KNIGHTCUBE_PWM=0x{config.coils.address:02x}",
        f"DeviceAllow={i2c} rw",
        f"DeviceAllow={unit} rw",
    ]
    camera = config.camera.device if config.camera is not None else None
    if isinstance(camera, V4l2Device):
        lines.append(f"DeviceAllow={camera.path} rw")
    elif camera is not None:  # Aravis talks to USB3 Vision cameras by libusb, which asks udev for them
        lines += ["DeviceAllow=char-usb_device rw", "RestrictAddressFamilies=AF_NETLINK"]
    return lines


def main() -> int:
    """Print the drop-in of the configuration that the command line names."""
    try:
        sys.stdout.write(dropin(load(Path(sys.argv[1]))))
    except UsageError as error:
        sys.stderr.write(f"install: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
