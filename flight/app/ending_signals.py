"""The signals that end a flight: SIGINT of Ctrl-C, SIGTERM, and the SIGHUP of a terminal that closes."""

from __future__ import annotations

import signal
import threading
from types import FrameType

from flight.loop.flight_loop import FlightLoop

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class EndingSignals:
    """Ends a flight after the running cycle, or at its first cycle when a signal comes while it opens.

    A second signal before the first cycle interrupts the opening. A SIGHUP that the process ignores, as under
    nohup, stays ignored. As a context the signals are taken for its duration.
    """

    def __init__(self) -> None:
        self._received: list[int] = []
        self._loop: FlightLoop | None = None
        self._before: dict[signal.Signals, object] = {}

    @property
    def received(self) -> bool:
        """Whether a signal has come."""
        return bool(self._received)

    def end(self, loop: FlightLoop) -> None:
        """End this flight when a signal comes, at once when one has come already."""
        self._loop = loop
        if self._received:
            self._stop(self._received[0])

    def __enter__(self) -> EndingSignals:
        # Signals come to the main thread alone; they do not end a flight in another, as a Dask worker's is.
        if threading.current_thread() is not threading.main_thread():
            return self
        for number in _ENDING:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # as `signal` returned it

    def _receive(self, number: int, _: FrameType | None) -> None:
        self._received.append(number)
        if self._loop is not None:
            self._stop(number)
        elif len(self._received) > 1:
            raise KeyboardInterrupt

    def _stop(self, number: int) -> None:
        assert self._loop is not None
        self._loop.stop(f"stopped by {signal.Signals(number).name}")
