"""Linux serial port through pyserial, with a thread that receives data and records their arrival times.

The receiving thread also reopens a lost port. A udev rule keeps the device name when an adapter is unplugged
and plugged in again.
"""

from __future__ import annotations

import os
import select
import termios
import threading
from collections import deque
from contextlib import suppress

import serial

from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SECOND_NS, Clock

_READ_TIMEOUT_S = 0.1  # longest delay until the thread notices that the port is to be closed
_WRITE_TIMEOUT_S = 0.005  # a fifth of a control cycle; usually the kernel's buffer accepts a command at once
_PENDING_LIMIT = 1 << 16
_REOPEN_S = 0.25

# Exceptions of pyserial's POSIX implementation; pyserial's own exceptions are subclasses of OSError.
_PORT_ERRORS = (OSError, termios.error, ValueError, TypeError)


class PySerialPort:
    """Serial port in raw 8N1 mode without flow control, opened exclusively.

    The class implements `hal.interfaces.wires.SerialPort`. The modem lines are neither read nor set, so that
    a pseudo-terminal works as well.

    Attributes:
        baud_rate: baud rate of the port, bits per second.
        lost_bytes: number of received bytes that were dropped because `receive` was not called for too long.
    """

    def __init__(
        self,
        device: str,
        baud_rate: int,
        clock: Clock,
        patient: bool = False,
        write_timeout: float = _WRITE_TIMEOUT_S,
    ) -> None:
        """Open the port.

        Raises NotResponding if the port cannot be opened. If `patient` is true, no error is raised: the port
        counts as lost, and is opened later. A call of `send` takes at most `write_timeout`, s; the default is
        short enough for the thread that drives the coils.
        """
        self.baud_rate = baud_rate
        self.lost_bytes = 0
        self._device = device
        self._write_timeout = write_timeout
        self._clock = clock
        self._pending: deque[tuple[int, bytes]] = deque()
        self._pending_bytes = 0
        self._lock = threading.Lock()
        # The lock is held while the port is used or replaced, because a closed descriptor may be reused.
        self._port_lock = threading.Lock()
        self._failure = ""
        self._closing = threading.Event()
        try:
            self._serial = self._open()
        except _PORT_ERRORS as error:
            self._failure = (
                f"cannot be opened at {baud_rate} baud ({error}): is the device plugged in, the name right, "
                "the port free, and may this user open it (group dialout)?"
            )
            if not patient:
                raise NotResponding(device, self._failure) from error
            self._serial = serial.Serial()  # not open
        self._thread = threading.Thread(target=self._read, name=f"serial {device}", daemon=True)
        self._thread.start()

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the data received since the last call as tuples (arrival_ns, bytes), oldest first.

        Raises NotResponding if the port is lost and all data received before the loss have been returned.
        """
        with self._lock:
            chunks = list(self._pending)
            self._pending.clear()
            self._pending_bytes = 0
        if not chunks and self._failure:
            raise NotResponding(self._device, self._failure)
        return chunks

    def send(self, data: bytes) -> None:
        """Write bytes. Raises NotResponding if the port is lost or the output queue remains full."""
        if self._failure:
            raise NotResponding(self._device, self._failure)
        try:
            with self._port_lock:
                self._write(data)
        except _PORT_ERRORS as error:
            message = f"writing failed ({error}): is the device still there?"
            raise NotResponding(self._device, message) from error

    def set_baud_rate(self, baud_rate: int) -> None:
        """Change the baud rate. Raises NotResponding if the port rejects the baud rate."""
        # The value is stored even if the port is lost, because the port is reopened at this baud rate.
        self.baud_rate = baud_rate
        try:
            with self._port_lock:
                self._serial.baudrate = baud_rate
        except _PORT_ERRORS as error:
            raise NotResponding(self._device, f"does not support {baud_rate} baud ({error})") from error

    def close(self) -> None:
        """Stop the thread and close the port. Calling `close` again has no effect."""
        if self._closing.is_set():
            return
        self._closing.set()
        with self._port_lock:
            self._serial.cancel_read()  # this has no effect on a closed port
        self._thread.join(timeout=2.0)
        self._serial.close()
        self._failure = self._failure or "the port was closed"

    def _write(self, data: bytes) -> None:
        """Write bytes, and wait while the output queue is full. Raises TimeoutError.

        The method `write` of pyserial also raises an error if all bytes were written but the thread was
        suspended in between.
        """
        file, until_ns = self._serial.fileno(), self._clock.now_ns() + round(self._write_timeout * SECOND_NS)
        while data:
            with suppress(BlockingIOError):
                data = data[os.write(file, data) :]
            left = max(until_ns - self._clock.now_ns(), 0) / SECOND_NS
            if data and not select.select([], [file], [], left)[1]:
                raise TimeoutError("the output queue is full")

    def _open(self) -> serial.Serial:
        return serial.Serial(
            self._device,
            self.baud_rate,
            timeout=_READ_TIMEOUT_S,
            exclusive=True,
        )

    def _read(self) -> None:
        if self._failure:
            self._open_again()
        while not self._closing.is_set():
            try:
                # The thread waits for the first byte, and then reads all bytes that have arrived.
                data = self._serial.read(1)
                if data:
                    data += self._serial.read(self._serial.in_waiting)
            except _PORT_ERRORS as error:
                if not self._closing.is_set():
                    self._failure = f"reading failed ({error}): is the device still there?"
                    self._open_again()
                continue
            if data:
                self._keep(self._clock.now_ns(), data)

    def _open_again(self) -> None:
        """Try to reopen the port until this succeeds or `close` is called.

        The receiving thread calls this method.
        """
        with self._port_lock:
            self._serial.close()
        while not self._closing.wait(_REOPEN_S):
            try:
                port = self._open()
            except _PORT_ERRORS:
                continue
            with self._port_lock:
                self._serial = port
            self._failure = ""
            return

    def _keep(self, arrival_ns: int, data: bytes) -> None:
        with self._lock:
            self._pending.append((arrival_ns, data))
            self._pending_bytes += len(data)
            while self._pending_bytes > _PENDING_LIMIT:
                _, oldest = self._pending.popleft()
                self._pending_bytes -= len(oldest)
                self.lost_bytes += len(oldest)
