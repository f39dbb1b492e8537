"""Three torque coils on a PCA9685 and their H-bridges: currents in; any failure leads to zero current.

`command` puts the newest currents into a mailbox and wakes a job of the clock; only that job, and a request
for zero, uses the bus. The job writes the newest command, replaces a stale one by zero, repeats zero at every
period while zero is requested, reads set-up and outputs back twice a second, sets the chip up again after a
brown-out, and never ends on a failure without having tried to write zero last.
"""

from __future__ import annotations

import math
import threading
from functools import lru_cache

import numpy as np

from hal.drivers.coil_mailbox import NONE, CommandMailbox
from hal.drivers.coil_outputs import CoilOutputs
from hal.drivers.coil_settings import DEVICE, CoilSettings
from hal.drivers.h_bridge import counts_for, current_step, largest_counts, mean_current
from hal.drivers.pca9685 import Pca9685
from hal.interfaces.errors import DeviceError, OutOfRange, Refused
from hal.interfaces.readings import CoilState, FloatArray
from hal.interfaces.wires import Clock, Ticker

SERVE_PERIOD_NS = 50_000_000
_OFF_PATIENCE = 0.3  # s that `off` waits for a transaction of the job before it writes without the lock
_AXES = "xyz"


class PwmTorqueCoils:
    """The torque coils. Safe to call from several threads; zero can be requested at any time."""

    def __init__(self, pca: Pca9685, clock: Clock, settings: CoilSettings) -> None:
        self._clock = clock
        self._settings = settings
        self._steps = tuple(current_step(coil.resistance, settings.supply_voltage) for coil in settings.coils)
        self._largest = tuple(largest_counts(step, settings.current_limit) for step in self._steps)
        # Currents of one count; the sign is exact in either place.
        self._signed = tuple(coil.sign * step for coil, step in zip(settings.coils, self._steps, strict=True))
        self._mailbox = CommandMailbox(clock, round(settings.stale_after * 1e9))
        self._outputs = CoilOutputs(pca, clock, settings, self._mailbox.lock)
        self._running = False
        self._ticker: Ticker | None = None
        # Re-entrant: a signal handler may request zero in the middle of its own thread's call.
        self._wire = threading.RLock()
        self._serving = False
        self._served = -1  # the number of the command on the wire

    def start(self, patient: bool = False) -> None:
        """Set the PWM chip up with every output off.

        Raises DeviceError when it is silent or refuses; a `patient` start reports that in `state` and keeps
        trying.
        """
        with self._wire:
            try:
                self._outputs.set_up()
            except DeviceError as error:
                self._try_zero()
                if not patient:
                    raise
                self._outputs.failing, self._outputs.error = True, str(error)
        with self._mailbox.lock:
            self._mailbox.withdraw()
            self._mailbox.braked = NONE
            self._running = True
            if self._ticker is None:
                self._ticker = self._clock.ticker(DEVICE, SERVE_PERIOD_NS, self._serve)

    def command(self, currents: FloatArray) -> None:
        """Request currents (3,) in A; values beyond the limit are limited. Never waits for the bus.

        Raises OutOfRange, and brings the coils to zero, for a wrong shape or a value that is not finite;
        Refused before `start` and after `close`.
        """
        values = np.asarray(currents, dtype=np.float64)
        problem = self._problem(values)
        ticker = self._ticker
        if problem is not None:
            self._mailbox.withdraw()
            if ticker is not None:
                ticker.kick()
            raise problem
        x, y, z = values.tolist()
        counts_x, limited_x = self._counts(0, x)
        counts_y, limited_y = self._counts(1, y)
        counts_z, limited_z = self._counts(2, z)
        with self._mailbox.lock:
            if ticker is None or not self._running:
                raise Refused(DEVICE, "a command before start() or after close()")
            self._mailbox.put((x, y, z), (counts_x, counts_y, counts_z), limited_x or limited_y or limited_z)
        ticker.kick()

    def brake(self, axes: tuple[bool, bool, bool]) -> None:
        """Hold both inputs of these bridges high from now on, whatever is commanded. Never waits for the bus.

        Refused before `start` and after `close`.
        """
        with self._mailbox.lock:
            ticker = self._ticker
            if ticker is None or not self._running:
                raise Refused(DEVICE, "a brake before start() or after close()")
            self._mailbox.brake(axes)
        ticker.kick()

    def off(self) -> None:
        """Bring all coils to zero now, with retries; returns when written or given up. Never raises.

        Any pending command is withdrawn, so that nothing energises the coils again until the next command.
        """
        self._mailbox.withdraw()
        held = self._wire.acquire(timeout=_OFF_PATIENCE)
        try:
            for left in reversed(range(self._settings.tries)):
                if self._try_zero():
                    if not self._outputs.failing:
                        self._outputs.error = ""
                    return
                if left:
                    self._outputs.wait()
            self._outputs.failing = True
        finally:
            if held:
                self._wire.release()

    def state(self) -> CoilState:
        """Return what is on the wire; after a failure, what was last acknowledged."""
        mailbox, outputs = self._mailbox, self._outputs
        with mailbox.lock:
            return _state_of(
                mailbox.command,
                outputs.written,
                self._signed,
                outputs.written_ns,
                mailbox.saturated,
                mailbox.command_ns,
                mailbox.stale,
                outputs.faults,
                outputs.error,
                outputs.braked,
            )

    def close(self) -> None:
        """Stop the job and bring the coils to zero. Safe to call twice. The shared bus stays open."""
        with self._mailbox.lock:
            was_running, self._running = self._running, False
            ticker, self._ticker = self._ticker, None
            self._mailbox.withdraw()
        if ticker is not None:
            ticker.stop()
        if was_running or self._outputs.failing or any(self._outputs.written):
            self.off()

    def _problem(self, values: FloatArray) -> OutOfRange | None:
        if values.shape != (3,):
            return OutOfRange(DEVICE, "number of currents", values.size, 3, 3, "")
        for axis, value in enumerate(values.tolist()):
            if not math.isfinite(value):
                bound = mean_current(self._largest[axis], self._steps[axis])
                return OutOfRange(DEVICE, f"current of coil {_AXES[axis]}", value, -bound, bound, "A")
        return None

    def _counts(self, axis: int, current: float) -> tuple[int, bool]:
        counts, limited = counts_for(current, self._steps[axis], self._largest[axis])
        return counts * self._settings.coils[axis].sign, limited

    def _try_zero(self) -> bool:
        return self._outputs.zero(self._mailbox.braked)

    def _serve(self) -> None:
        """Bring the wire up to date; the job of the clock."""
        with self._wire:
            # Re-entered while waiting: simulated time runs then, and signals arrive.
            if self._serving or not self._running:
                return
            self._serving = True
            try:
                self._update_outputs()
            finally:
                self._serving = False

    def _update_outputs(self) -> None:
        outputs = self._outputs
        counts, _, number = self._mailbox.newest()
        due = outputs.check_is_due()
        if number == self._served and any(counts) and not due and not outputs.failing:
            return
        # A failing chip first gets the one message that is right in every state: off.
        if outputs.failing and not self._try_zero():
            return
        try:
            doubtful = outputs.failing
            repaired = ""
            if (outputs.failing or due) and not outputs.is_intact():
                repaired = "" if outputs.failing else outputs.error
                outputs.configure()
                doubtful = True
            self._write_newest()
            if doubtful and not outputs.keeps_written():
                raise outputs.not_kept()
        except DeviceError as error:
            outputs.failing = True
            self._try_zero()
            outputs.error = str(error)
        else:
            outputs.failing = False
            # A failure that was repaired at once is still reported until the next period.
            outputs.error = repaired

    def _write_newest(self) -> None:
        for left in reversed(range(self._settings.tries)):
            # Read again at each try: a newer command counts, above all a withdrawal.
            counts, braked, number = self._mailbox.newest()
            try:
                self._outputs.write(counts, braked)
            except DeviceError as error:
                self._outputs.count(error)
                if left == 0:
                    raise
                self._outputs.wait()
            else:
                self._served = number
                if number == self._mailbox.number:
                    return


@lru_cache(maxsize=4)
def _state_of(
    command: tuple[float, ...],
    written: tuple[int, ...],
    signed: tuple[float, ...],
    written_ns: int,
    saturated: bool,
    command_ns: int,
    stale: bool,
    faults: int,
    error: str,
    braked: tuple[bool, bool, bool],
) -> CoilState:
    """Return the state, made once for all who ask in a cycle; `signed` A are the currents of a count."""
    return CoilState(
        command=np.array(command),
        current=np.array([mean_current(*axis) for axis in zip(written, signed, strict=True)]),
        written_ns=written_ns,
        saturated=saturated,
        command_ns=command_ns,
        stale=stale,
        faults=faults,
        error=error,
        braked=braked,
    )
