"""Results that all tests of a session share, whichever worker process a test runs in."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


def made_once(folder: Path, name: str, make: Callable[[], Any]) -> Any:
    """Return the result of `make` in its JSON form. Only the first caller in a session calls `make`.

    `folder` is below the fixture `session_folder`. Callers in other processes wait for the result. If `make`
    raises an exception, the next caller calls `make` again.
    """
    kept = folder / f"{name}.json"
    with (folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            text = json.dumps(make())
            kept.write_text(text, encoding="utf-8")
    return json.loads(kept.read_text(encoding="utf-8"))
