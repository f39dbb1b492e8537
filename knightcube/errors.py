"""Exceptions of the library and the flight application. Attributes of each exception contain the details."""

from __future__ import annotations

import errno
from typing import Any

_REMEDIES = {
    errno.EACCES: "change the owner or the permissions, or give another path",
    errno.EEXIST: "give another name",
    errno.EISDIR: "give the name of a file",
    errno.ENOENT: "check the path",
    errno.ENOSPC: "delete files, or give a path on another disk",
    errno.ENOTDIR: "a part of the path is a file; give another path",
    errno.EROFS: "give a path on another disk",
}
"""Remedies for errors of the operating system, by error number."""


class KnightCubeError(Exception):
    """Base class of all errors that the library and the flight application define.

    The message of an error states the value and the remedy.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts for pickling; `args` has only the text, not the arguments of `__init__`."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class UsageError(KnightCubeError):
    """Error made by the user, such as a file that is not an image or an argument that is out of range.

    The message states the error and its remedy in one line. A command prints the message without a traceback
    and ends with status 2.
    """


class InputError(UsageError):
    """Error raised for an unusable file, or for an unusable value in a file.

    Attributes:
        where: path of the file, or dotted name of the configuration value.
        problem: description of the error and its remedy.
    """

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(f"{where}: {problem}")
        self.where = where
        self.problem = problem


class ArgumentError(InputError, ValueError):
    """Error raised if an argument of a library function has an unusable value.

    The attribute `where` is the name of the argument. The error is also a ValueError.
    """


class PlanningError(UsageError):
    """Error raised if a planner finds no path, or if one of its arguments is out of range.

    The message states the reason and the remedy. If the arguments are valid and no path is found, a command
    ends with status 1. The attribute `is_hopeless` states whether a slew exceeds the dipole limit by so much
    that no other start time would be feasible.
    """

    is_hopeless = False


def reason_of(error: OSError) -> str:
    """Return the reason why a file operation failed and, for frequent reasons, the remedy."""
    reason, remedy = str(error.strerror or error), _REMEDIES.get(error.errno or 0)
    return f"{reason}; {remedy}" if remedy else reason


def shown(text: str) -> str:
    """Return a text with its unprintable characters replaced by escape sequences."""
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return "".join(escaped)
