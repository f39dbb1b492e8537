"""How many boots there were, noted beside the stored state: shows copies that vanished or are of long ago.

Copies that are whole may still be old: a file system repaired after damage, a folder restored from a backup.
The number of each boot is noted in the state's folder and in that of its run, so that a state which counts
fewer boots than any of them is recognised.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from flight.loop.state.files import LinuxFiles, replace_file

NOTE = "boots"


def note_boot(folders: Iterable[Path], number: int) -> None:
    """Note the number of a boot in some folders. Never raises."""
    for folder in folders:
        with suppress(OSError):
            replace_file(LinuxFiles(), folder / NOTE, b"%d\n" % number)


def newest_boot(folders: Iterable[Path]) -> int:
    """Return the highest number noted in some folders, 0 where there is none. Never raises."""
    numbers = [0]
    for folder in folders:
        with suppress(OSError):
            text = (LinuxFiles().read(folder / NOTE) or b"").strip()
            if text.isdigit() and len(text) < 16:  # 2^53, the highest count, has 16 digits
                numbers.append(int(text))
    return max(numbers)
