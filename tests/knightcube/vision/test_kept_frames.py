"""Frames on disk: another's reader of pictures opens them, what was found stands in them, old ones go."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from knightcube.vision.kept_frames import KeptFrames, facts_of, keep_frame


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_another_reader_opens_the_newest_frames(tmp_path: Path, kind: type[np.unsignedinteger]) -> None:
    pixels = (np.arange(60).reshape(6, 10) * (1000 if kind is np.uint16 else 4)).astype(kind)
    folder = tmp_path / "frames"
    for number in range(5):
        keep_frame(KeptFrames(folder, 3, f"frame-{number:08d}"), pixels, {"stars": "solved"})
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"frame-{number:08d}.pgm" for number in (2, 3, 4)]
    with Image.open(folder / names[0]) as picture:
        np.testing.assert_array_equal(np.asarray(picture), pixels)
    assert facts_of((folder / names[0]).read_bytes()) == {"stars": "solved"}


def test_a_disk_that_takes_nothing_costs_the_frame_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    keep_frame(KeptFrames(tmp_path / "file" / "frames", 3, "a"), np.zeros((2, 2), np.uint8), {})
    with pytest.raises(ValueError, match="no kept frame"):
        facts_of(b"P5\n2 2\n255\n")
