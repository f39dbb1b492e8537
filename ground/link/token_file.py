"""The file in which a running gateway leaves its token for programs of the same user."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from knightcube.errors import FlightError


def token_path(keys: Path, port: int) -> Path:
    """Return the file with the token of the gateway that has these keys and listens on this port."""
    return keys / f"gateway-{port}.token"


@contextmanager
def token_file(path: Path, token: str) -> Iterator[None]:
    """Write a token, as a line that its user alone can read, and remove the file at the end.

    A file of a gateway that was killed is replaced. Raises FlightError if the file cannot be written.
    """
    new = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        new.unlink(missing_ok=True)
        file = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(file, "w", encoding="ascii") as out:
            out.write(f"{token}\n")
        new.replace(path)
    except OSError as error:
        raise FlightError(f"{path}: the token cannot be written: {error.strerror or error}") from error
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
