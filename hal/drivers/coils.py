"""Three torque coils on a PCA9685 and their H-bridges: currents in, zero on any doubt.

`command` leaves the newest currents in a mailbox and wakes a job of the clock; only that job, and whoever
asks for zero, touches the bus. The job writes the newest command, lets a stale one fall to zero, says zero
again at every period while zero is wanted, reads set-up and outputs back twice a second, sets the chip up
again after a brown-out, and never ends on a failure without having tried zero last.

Zero is both inputs of a bridge low, the one message that needs no set-up of the chip. Where a leg is known to
be stuck high that would drive its coil: such a bridge is braked, both inputs high, right after it.
"""

from __future__ import annotations

import math
import threading

import numpy as np

from hal.drivers.coil_settings import DEVICE, CoilSettings
from hal.drivers.h_bridge import (
    brake,
    counts_for,
    current_step,
    enable_for,
    inputs_for,
    largest_counts,
    mean_current,
)
from hal.drivers.pca9685 import Pca9685, PwmCounts
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused
from hal.interfaces.readings import CoilState, FloatArray
from hal.interfaces.wires import Clock, Ticker

SERVE_PERIOD_NS = 50_000_000
_CHECK_PERIOD_NS = 500_000_000
_OFF_PATIENCE = 0.3  # s that `off` waits for a transaction of the job, before it writes regardless
_AXES = "xyz"
_ZERO = (0, 0, 0)
_NONE = (False, False, False)

_Counts = tuple[int, int, int]
_Axes = tuple[bool, bool, bool]


class PwmTorqueCoils:
    """The torque coils. Safe to call from several threads; zero can be asked for at any time."""

    def __init__(self, pca: Pca9685, clock: Clock, settings: CoilSettings) -> None:
        self._pca = pca
        self._clock = clock
        self._settings = settings
        self._steps = tuple(current_step(coil.resistance, settings.supply_voltage) for coil in settings.coils)
        self._largest = tuple(largest_counts(step, settings.current_limit) for step in self._steps)
        self._blocks = settings.blocks()
        self._stale_ns = round(settings.stale_after * 1e9)
        self._retry_ns = round(settings.retry_wait * 1e9)
        # Both locks are re-entrant: a signal handler may ask for zero in the middle of its own thread's call.
        self._mailbox = threading.RLock()
        self._wanted: _Counts | None = None  # None: zero
        self._braked = _NONE  # wanted
        self._number = 0  # of the newest command, withdrawal or brake
        self._command: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._command_ns = -1
        self._saturated = False
        self._stale = False
        self._running = False
        self._ticker: Ticker | None = None
        self._wire = threading.RLock()
        self._serving = False
        self._written = _ZERO
        self._written_braked = _NONE
        self._written_ns = -1
        self._served = -1  # the number whose counts are on the wire
        self._lost = False
        self._check_ns = 0
        self._faults = 0
        self._error = ""

    def start(self, patient: bool = False) -> None:
        """Set the PWM chip up with every output off.

        Raises DeviceError when it is silent or refuses; a `patient` start tells so in `state` and goes on
        trying.
        """
        with self._wire:
            try:
                self._set_up()
            except DeviceError as error:
                self._try_zero()
                if not patient:
                    raise
                self._lost, self._error = True, str(error)
        with self._mailbox:
            self._withdraw()
            self._braked = _NONE
            self._running = True
            if self._ticker is None:
                self._ticker = self._clock.ticker(DEVICE, SERVE_PERIOD_NS, self._serve)

    def _set_up(self) -> None:
        for left in reversed(range(self._settings.tries)):
            try:
                self._configure()
            except DeviceError as error:
                self._count(error)
                if left == 0:
                    raise
                self._wait()
            else:
                self._lost, self._error = False, ""
                return

    def command(self, currents: FloatArray) -> None:
        """Ask for currents (3,) in A; limited explicitly. Never waits for the bus.

        Raises OutOfRange, and brings the coils to zero, for a wrong shape or a value that is not finite;
        Refused before `start` and after `close`.
        """
        values = np.asarray(currents, dtype=np.float64)
        problem = self._problem(values)
        ticker = self._ticker
        if problem is not None:
            with self._mailbox:
                self._withdraw()
            if ticker is not None:
                ticker.kick()
            raise problem
        x, y, z = values.tolist()
        counts_x, limited_x = self._counts(0, x)
        counts_y, limited_y = self._counts(1, y)
        counts_z, limited_z = self._counts(2, z)
        with self._mailbox:
            if ticker is None or not self._running:
                raise Refused(DEVICE, "a command before start() or after close()")
            self._command = (x, y, z)
            self._command_ns = self._clock.now_ns()
            self._wanted = (counts_x, counts_y, counts_z)
            self._saturated = limited_x or limited_y or limited_z
            self._stale = False
            self._number += 1
        ticker.kick()

    def brake(self, axes: tuple[bool, bool, bool]) -> None:
        """Hold both inputs of these bridges high from now on, whatever is commanded. Never waits for the bus.

        Refused before `start` and after `close`.
        """
        with self._mailbox:
            ticker = self._ticker
            if ticker is None or not self._running:
                raise Refused(DEVICE, "a brake before start() or after close()")
            self._braked = axes
            self._number += 1
        ticker.kick()

    def off(self) -> None:
        """Bring all coils to zero now, with retries; returns when written or given up. Never raises.

        Any pending command is withdrawn, so that nothing energises the coils again until the next one.
        """
        with self._mailbox:
            self._withdraw()
        held = self._wire.acquire(timeout=_OFF_PATIENCE)
        try:
            for left in reversed(range(self._settings.tries)):
                if self._try_zero():
                    if not self._lost:
                        self._error = ""
                    return
                if left:
                    self._wait()
            self._lost = True
        finally:
            if held:
                self._wire.release()

    def state(self) -> CoilState:
        """Return what is on the wire; after a failure, what was last acknowledged."""
        with self._mailbox:
            return CoilState(
                command=np.array(self._command),
                current=np.array(list(map(self._mean_current, range(3), self._written))),
                written_ns=self._written_ns,
                saturated=self._saturated,
                command_ns=self._command_ns,
                stale=self._stale,
                faults=self._faults,
                error=self._error,
                braked=self._written_braked,
            )

    def close(self) -> None:
        """Stop the job and bring the coils to zero. Safe to call twice. The shared bus stays open."""
        with self._mailbox:
            was_running, self._running = self._running, False
            ticker, self._ticker = self._ticker, None
            self._withdraw()
        if ticker is not None:
            ticker.stop()
        if was_running or self._lost or any(self._written):
            self.off()

    def _problem(self, values: FloatArray) -> OutOfRange | None:
        if values.shape != (3,):
            return OutOfRange(DEVICE, "number of currents", values.size, 3, 3, "")
        for axis, value in enumerate(values.tolist()):
            if not math.isfinite(value):
                bound = self._mean_current(axis, self._largest[axis] * self._settings.coils[axis].sign)
                return OutOfRange(DEVICE, f"current of coil {_AXES[axis]}", value, -bound, bound, "A")
        return None

    def _counts(self, axis: int, current: float) -> tuple[int, bool]:
        counts, limited = counts_for(current, self._steps[axis], self._largest[axis])
        return counts * self._settings.coils[axis].sign, limited

    def _mean_current(self, axis: int, counts: int) -> float:
        return self._settings.coils[axis].sign * mean_current(counts, self._steps[axis])

    def _withdraw(self) -> None:
        """Want zero; the mailbox is held."""
        self._wanted = None
        self._command = (0.0, 0.0, 0.0)
        self._saturated = False
        self._stale = False
        self._number += 1

    def _newest(self) -> tuple[_Counts, int]:
        """Return the counts that should be on the wire now, and their number."""
        with self._mailbox:
            if self._wanted is not None and self._clock.now_ns() - self._command_ns > self._stale_ns:
                self._wanted = None
                self._saturated = False
                self._stale = True
                self._number += 1
            x, y, z = self._wanted or _ZERO
            brake_x, brake_y, brake_z = self._braked
            return (0 if brake_x else x, 0 if brake_y else y, 0 if brake_z else z), self._number

    def _serve(self) -> None:
        """Bring the wire up to date; the job of the clock."""
        with self._wire:
            # A job may be entered again from within: waiting lets simulated time run, signals come in.
            if self._serving or not self._running:
                return
            self._serving = True
            try:
                self._bring_up_to_date()
            finally:
                self._serving = False

    def _bring_up_to_date(self) -> None:
        counts, number = self._newest()
        due = self._clock.now_ns() >= self._check_ns
        if number == self._served and any(counts) and not due and not self._lost:
            return
        # Whoever was lost is asked with the one message that is right in every state: off.
        if self._lost and not self._try_zero():
            return
        try:
            doubtful = self._lost
            trouble = ""
            if (self._lost or due) and not self._is_configured():
                trouble = "" if self._lost else self._error
                self._configure()
                doubtful = True
            self._write_newest()
            if doubtful and not self._keeps_written():
                raise Refused(self._pca.name, "does not keep what is written to its outputs")
        except DeviceError as error:
            self._lost = True
            self._try_zero()
            self._error = str(error)
        else:
            self._lost = False
            # What was found and mended in one go is told until the next time: somebody should know.
            self._error = trouble

    def _is_configured(self) -> bool:
        for left in reversed(range(self._settings.tries)):
            try:
                held = self._pca.is_configured()
                # Zero is said in more than one way, and again at each period: it is not asked for here.
                driven = any(self._written) or any(self._written_braked)
                kept = held and (not driven or self._keeps_written())
            except NotResponding as error:
                self._count(error)
                if left == 0:
                    raise
                self._wait()
            else:
                if kept:
                    self._check_ns = self._clock.now_ns() + _CHECK_PERIOD_NS
                elif held:
                    self._count(Refused(self._pca.name, "does not keep what is written to its outputs"))
                else:
                    self._count(Refused(self._pca.name, "has lost its set-up (brown-out?)"))
                return kept
        raise AssertionError("tries is at least 1")

    def _configure(self) -> None:
        self._pca.configure()
        self._note(_ZERO, _NONE)
        self._check_ns = self._clock.now_ns() + _CHECK_PERIOD_NS

    def _write_newest(self) -> None:
        for left in reversed(range(self._settings.tries)):
            # Asked for at each try: what came in meanwhile counts, above all a withdrawal.
            counts, number = self._newest()
            braked = self._braked
            try:
                self._write(counts, braked)
            except DeviceError as error:
                self._count(error)
                if left == 0:
                    raise
                self._wait()
            else:
                self._note(counts, braked)
                self._served = number
                if number == self._number:
                    return

    def _keeps_written(self) -> bool:
        """Tell whether the outputs are what was last written to them. Raises NotResponding."""
        blocks = self._channel_blocks(self._written, self._written_braked)
        return all(self._pca.holds(first, block) for first, block in blocks)

    def _write(self, counts: _Counts, braked: _Axes) -> None:
        for first, block in self._channel_blocks(counts, braked):
            self._pca.write_channels(first, block)

    def _channel_blocks(self, counts: _Counts, braked: _Axes) -> list[tuple[int, list[PwmCounts]]]:
        """Return (first channel, counts of it and its neighbours) for signed counts of the coils."""
        pins: list[PwmCounts] = []
        for coil, value, held in zip(self._settings.coils, counts, braked, strict=True):
            pins += brake() if held else inputs_for(value)
            if coil.enable_channel is not None:
                pins.append(enable_for(value))
        return [(first, [pins[member] for member in members]) for first, members in self._blocks]

    def _try_zero(self) -> bool:
        """Say zero once, and brake what is to be braked; tell whether it was acknowledged."""
        try:
            self._pca.all_off()
            self._note(_ZERO, _NONE)
            # A chip that may have lost its set-up would take a block for something else.
            if any(self._braked) and not self._lost:
                self._write(_ZERO, self._braked)
                self._note(_ZERO, self._braked)
        except NotResponding as error:
            self._count(error)
            return False
        return True

    def _note(self, counts: _Counts, braked: _Axes) -> None:
        """Keep what the chip has acknowledged; a repetition does not change since when."""
        with self._mailbox:
            if self._written_ns < 0 or (counts, braked) != (self._written, self._written_braked):
                self._written, self._written_braked = counts, braked
                self._written_ns = self._clock.now_ns()

    def _count(self, error: DeviceError) -> None:
        self._faults += 1
        self._error = str(error)

    def _wait(self) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + self._retry_ns)
