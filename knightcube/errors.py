"""The exceptions of the library and the flight application; each carries its facts as attributes."""

from __future__ import annotations


class FlightError(Exception):
    """The base of all errors of the library and the flight application."""


class UsageError(FlightError):
    """A user's mistake: reported in one line, exit status 2, never a traceback."""


class InputError(UsageError):
    """A file, or a value in one, that cannot be used.

    Attributes:
        where: the file or the dotted name of the value.
        problem: the fault and its remedy.
    """

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(f"{where}: {problem}")
        self.where = where
        self.problem = problem


class PlanningError(FlightError):
    """No path was found; the message says why."""
