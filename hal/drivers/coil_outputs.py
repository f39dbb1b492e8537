"""The outputs of the PWM chip that drive the coils: written, read back, set up again after a brown-out.

Zero is both inputs of a bridge low, the one message that needs no set-up of the chip. A leg that is known to
be stuck high would then drive its coil: such a bridge is braked, both inputs high, right after.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import RLock
from typing import TypeVar

from hal.drivers.coil_mailbox import NONE, ZERO, Axes, Counts
from hal.drivers.coil_settings import CoilSettings
from hal.drivers.h_bridge import brake, enable_for, inputs_for
from hal.drivers.pca9685 import Pca9685, PwmCounts
from hal.interfaces.errors import DeviceError, NotResponding, Refused
from hal.interfaces.wires import Clock

_CHECK_PERIOD_NS = 500_000_000

_Answer = TypeVar("_Answer")


class CoilOutputs:
    """Writes signed counts to the PWM chip and records what the chip acknowledged.

    Attributes:
        written: signed counts of the coils that the chip acknowledged last.
        braked: the bridges that are braked, likewise.
        written_ns: host time since when those are on the wire, -1 before the first.
        failing: the last exchange failed; the chip's state is not known.
        faults: failed transactions since start.
        error: the text of the last failure while it lasts.
    """

    def __init__(self, pca: Pca9685, clock: Clock, settings: CoilSettings, lock: RLock) -> None:
        """Drive the chip; `lock` guards `written`, `braked` and `written_ns`."""
        self.written = ZERO
        self.braked = NONE
        self.written_ns = -1
        self.failing = False
        self.faults = 0
        self.error = ""
        self._pca = pca
        self._clock = clock
        self._settings = settings
        self._lock = lock
        self._blocks = settings.blocks()
        self._retry_ns = round(settings.retry_wait * 1e9)
        self._check_ns = 0

    def set_up(self) -> None:
        """Set the chip up with every output off, with retries. Raises DeviceError."""
        self._retried(self.configure)
        self.failing, self.error = False, ""

    def configure(self) -> None:
        """Set the chip up with every output off, once. Raises DeviceError."""
        self._pca.configure()
        self._record(ZERO, NONE)
        self._postpone_check()

    def check_is_due(self) -> bool:
        """Return whether set-up and outputs should be read back now."""
        return self._clock.now_ns() >= self._check_ns

    def is_intact(self) -> bool:
        """Return whether the chip holds its set-up and outputs, with retries. Raises NotResponding."""
        held, kept = self._retried(self._read_back)
        if kept:
            self._postpone_check()
        elif held:
            self.count(self.not_kept())
        else:
            self.count(Refused(self._pca.name, "has lost its set-up (brown-out?)"))
        return kept

    def keeps_written(self) -> bool:
        """Return whether the outputs hold what was last written to them. Raises NotResponding."""
        blocks = self._channel_blocks(self.written, self.braked)
        return all(self._pca.holds(first, block) for first, block in blocks)

    def not_kept(self) -> DeviceError:
        """Return the error of a chip whose outputs differ from what was written."""
        return Refused(self._pca.name, "does not keep what is written to its outputs")

    def write(self, counts: Counts, braked: Axes) -> None:
        """Write signed counts and brakes, once. Raises DeviceError."""
        self._write(counts, braked)
        self._record(counts, braked)

    def zero(self, braked: Axes) -> bool:
        """Write zero once, then brake the bridges of `braked`; return whether that was acknowledged."""
        try:
            self._pca.all_off()
            self._record(ZERO, NONE)
            # A chip that may have lost its set-up would misread a block.
            if any(braked) and not self.failing:
                self.write(ZERO, braked)
        except NotResponding as error:
            self.count(error)
            return False
        return True

    def count(self, error: DeviceError) -> None:
        """Count a failed transaction and keep its text."""
        self.faults += 1
        self.error = str(error)

    def wait(self) -> None:
        """Wait before the next try."""
        self._clock.sleep_until_ns(self._clock.now_ns() + self._retry_ns)

    def _retried(self, action: Callable[[], _Answer]) -> _Answer:
        """Return what `action` returns, tried a few times; raises the last DeviceError."""
        for left in reversed(range(self._settings.tries)):
            try:
                return action()
            except DeviceError as error:
                self.count(error)
                if left == 0:
                    raise
                self.wait()
        raise AssertionError("tries is at least 1")

    def _read_back(self) -> tuple[bool, bool]:
        """Return whether the chip holds its set-up, and whether its outputs as well."""
        held = self._pca.is_configured()
        # Zero is sent in more than one way, and again at each period, so it is not read back.
        driven = any(self.written) or any(self.braked)
        return held, held and (not driven or self.keeps_written())

    def _postpone_check(self) -> None:
        self._check_ns = self._clock.now_ns() + _CHECK_PERIOD_NS

    def _write(self, counts: Counts, braked: Axes) -> None:
        for first, block in self._channel_blocks(counts, braked):
            self._pca.write_channels(first, block)

    def _channel_blocks(self, counts: Counts, braked: Axes) -> list[tuple[int, list[PwmCounts]]]:
        """Return (first channel, counts from there on) of each block for signed counts of the coils."""
        pins: list[PwmCounts] = []
        for coil, value, held in zip(self._settings.coils, counts, braked, strict=True):
            pins += brake() if held else inputs_for(value)
            if coil.enable_channel is not None:
                pins.append(enable_for(value))
        return [(first, [pins[member] for member in members]) for first, members in self._blocks]

    def _record(self, counts: Counts, braked: Axes) -> None:
        """Record what the chip acknowledged; a repetition keeps its first time."""
        with self._lock:
            if self.written_ns < 0 or (counts, braked) != (self.written, self.braked):
                self.written, self.braked = counts, braked
                self.written_ns = self._clock.now_ns()
