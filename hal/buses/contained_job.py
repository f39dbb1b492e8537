"""A background job that may fail without ending the thread, or the simulation, that runs it."""

from __future__ import annotations

from collections.abc import Callable


class ContainedJob:
    """Runs a job; an exception that escapes it is kept, not raised.

    Attributes:
        name: of the job, for people.
        error: what escaped from the last run, empty when it came to its end.
        served_ns: when a run last came to its end, or the time given at the making.
    """

    def __init__(self, name: str, job: Callable[[], None], now_ns: Callable[[], int]) -> None:
        self.name = name
        self.error = ""
        self.served_ns = now_ns()
        self._job = job
        self._now_ns = now_ns

    def run(self) -> None:
        """Run the job once. Never raises."""
        try:
            self._job()
        except Exception as error:  # noqa: BLE001 - containment boundary: the ticker
            self.error = f"{type(error).__name__}: {error}"
        else:
            self.error = ""
            self.served_ns = self._now_ns()
