"""A background job whose failure does not end the thread, or the simulation, that runs it."""

from __future__ import annotations

from collections.abc import Callable


class ContainedJob:
    """Runs a job; keeps an exception that escapes instead of raising it.

    Attributes:
        name: of the job.
        error: the exception of the last run as text, empty when it completed.
        served_ns: when a run last completed, or when this object was made.
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
