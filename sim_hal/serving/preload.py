"""Compiles the library by which unchanged programs open the emulated bus, once for each version of it."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

from knightcube.errors import UsageError

SOURCE = Path(__file__).with_name("i2c_preload.c")
_FLAGS = ("-shared", "-fPIC", "-O2", "-w")
_COMPILERS = ("cc", "gcc", "clang")


def library() -> Path:
    """Return the compiled library, from the user's cache if it is there. Raises UsageError."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "knightcube"
    text = SOURCE.read_bytes()
    path = folder / f"i2c-preload-{os.uname().machine}-{hashlib.sha256(text).hexdigest()[:16]}.so"
    if path.is_file():
        return path
    compiler = _compiler()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(f".{os.getpid()}")
        command = [compiler, *_FLAGS, "-o", str(beside), str(SOURCE), "-ldl", "-lpthread"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise UsageError(f"{folder}: the preload library cannot be written: {error.strerror}") from error
    if done.returncode != 0:
        first = next(iter(done.stderr.splitlines()), f"status {done.returncode}")
        raise UsageError(f"the preload library does not compile: {first} (Debian: apt-get install libc6-dev)")
    beside.replace(path)
    return path


def _compiler() -> str:
    named = os.environ.get("CC")
    for name in (named,) if named else _COMPILERS:
        if found := shutil.which(name):
            return found
    raise UsageError(
        f"no C compiler ({named or ', '.join(_COMPILERS)}) to build the preload library with: install one"
        " (Debian: apt-get install gcc libc6-dev) or name it by CC"
    )
