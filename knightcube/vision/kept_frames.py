"""Keeps the newest frames on disk with what was found in them; the vision worker does it.

A file is a PGM (Netpbm), which any image program opens: grey counts of 8 or 16 bits as the camera gave them,
and before them, as comments, what was found, in JSON. A disk that takes nothing costs the frame alone.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import Image

FOLDER = "frames"
"""Of a run's folder."""


@dataclass(frozen=True, slots=True)
class KeptFrames:
    """Where frames are kept, and how many; `name` is that of one frame's file, without its ending."""

    folder: Path
    most: int
    name: str = ""


def keep_frame(kept: KeptFrames, pixels: Image, facts: dict[str, Any]) -> None:
    """Write a frame (rows, columns) and what was found in it; delete the oldest beyond the number."""
    with suppress(OSError):
        kept.folder.mkdir(exist_ok=True)
        beside = kept.folder / "frame~"
        beside.write_bytes(portable_grey_map(pixels, facts))
        beside.replace(kept.folder / f"{kept.name}.pgm")
        for old in sorted(kept.folder.glob("*.pgm"))[: -kept.most]:
            old.unlink()


def portable_grey_map(pixels: Image, facts: dict[str, Any]) -> bytes:
    """Return the bytes of a PGM of whole counts, 16 bits where 8 do not hold them."""
    deep = pixels.dtype.itemsize > 1
    rows, columns = pixels.shape
    text = json.dumps(facts)
    head = f"P5\n# {text}\n{columns} {rows}\n{65535 if deep else 255}\n"
    return head.encode("ascii") + pixels.astype(np.dtype(">u2") if deep else np.uint8).tobytes()


def facts_of(data: bytes) -> dict[str, Any]:
    """Return what stands in a frame's file beside the picture. Raises ValueError where nothing does."""
    head, _, rest = data.partition(b"\n# ")
    if head != b"P5":
        raise ValueError("no kept frame")
    facts: dict[str, Any] = json.loads(rest.partition(b"\n")[0])
    return facts
