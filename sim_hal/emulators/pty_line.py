"""A serial line for any client: the device end of a pseudo-terminal, paced in real time at the line's speed.

The other side's speed is read from the terminal, so that the wrong one garbles here as it does on a cable.
"""

from __future__ import annotations

import errno
import os
import select
import termios
import tty
from pathlib import Path

import numpy as np

from sim_hal.emulators.serial_line import Wire

_SPEEDS = {
    getattr(termios, f"B{rate}"): rate
    for rate in (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
    if hasattr(termios, f"B{rate}")
}
_CODES = {rate: code for code, rate in _SPEEDS.items()}


class PtyLine:
    """The device's end of a line whose host end is a pseudo-terminal; a `SerialEnd`.

    Attributes:
        name: the device file that a host opens.
        baud_rate: the device's own speed.
        to_host, to_device: the two wires, each with its faults.
    """

    def __init__(self, baud_rate: int, rng: np.random.Generator, link: Path | None = None) -> None:
        """Open the terminal; `link` is made a symbolic link to it. Raises OSError when one cannot be made."""
        self.baud_rate = baud_rate
        to_host_rng, to_device_rng = rng.spawn(2)
        self.to_host = Wire(to_host_rng)
        self.to_device = Wire(to_device_rng)
        # The far side stays open here: without any opener a terminal reports an error. A raw one has no echo.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        self._set_speed(baud_rate)
        os.set_blocking(self._near, False)
        self.name = os.ttyname(self._far)
        self._link = link
        if link is not None:
            try:
                if link.is_symlink():
                    link.unlink()
                link.symlink_to(self.name)
            except OSError:
                self._link = None
                self.close()
                raise

    def write(self, data: bytes, now_ns: int) -> None:
        """Start to send bytes at `now_ns`."""
        self.to_host.push(data, now_ns, self.baud_rate, self._host_speed())

    def read(self, now_ns: int) -> bytes:
        """Return the host's bytes that have crossed by `now_ns`."""
        return b"".join(data for _, data in self.to_device.pull(now_ns))

    def next_arrival_ns(self) -> int:
        """Return when the host's bytes will next have crossed."""
        return self.to_device.next_arrival_ns()

    def exchange(self, now_ns: int) -> None:
        """Accept the host's bytes; deliver the device's that have crossed by `now_ns`."""
        try:
            data = os.read(self._near, 4096)
        except BlockingIOError:
            data = b""
        if data:
            speed = self._host_speed()
            self.to_device.push(data, now_ns, speed, self.baud_rate)
        for _, crossed in self.to_host.pull(now_ns):
            try:
                os.write(self._near, crossed)
            except OSError as error:
                # Without a reader the bytes are lost, as on an unconnected cable.
                if error.errno != errno.EAGAIN:
                    raise

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the host writes, for select."""
        return self._near

    def wait(self, now_ns: int, until_ns: int) -> None:
        """Wait until the host writes, a message has crossed to it, or `until_ns`."""
        due_ns = min(until_ns, self.to_host.next_arrival_ns())
        select.select([self._near], [], [], max(0, due_ns - now_ns) * 1e-9)

    def close(self) -> None:
        """Close the terminal and remove the link. Safe to call twice."""
        if self._near < 0:
            return
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._near)
        os.close(self._far)
        self._near = self._far = -1

    def _host_speed(self) -> int:
        # A speed without a name (128000) cannot be read back this way: assume that it is right.
        return _SPEEDS.get(termios.tcgetattr(self._far)[5], self.baud_rate)

    def _set_speed(self, baud_rate: int) -> None:
        code = _CODES.get(baud_rate)
        if code is not None:
            attributes = termios.tcgetattr(self._far)
            attributes[4] = attributes[5] = code
            termios.tcsetattr(self._far, termios.TCSANOW, attributes)
