"""FITS images made by hand, card by card, as the FITS Standard 4.0 has them."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knightcube.astro.arrays import Image
from knightcube.errors import UsageError
from knightcube.vision.camera.images import primary_image, read_image

PIXELS = np.array([[0, 1, 2], [127, 128, 255]])


def _card(keyword: str, value: object) -> bytes:
    return f"{keyword:<8}= {value!s:>20} / of the test".ljust(80).encode("ascii")


def _file(stored: Image, bits: int, **cards: object) -> bytes:
    """Return a FITS file of `stored` (rows, columns), with `cards` after or instead of the mandatory ones."""
    header: dict[str, object] = {"SIMPLE": "T", "BITPIX": bits, "NAXIS": 2}
    header |= {"NAXIS1": stored.shape[1], "NAXIS2": stored.shape[0]} | cards
    text = b"".join(_card(keyword, value) for keyword, value in header.items() if value is not None)
    text += b"COMMENT   END = 3 is no end".ljust(80) + b"END".ljust(80)
    body = stored.tobytes()
    return text.ljust(-(-len(text) // 2880) * 2880) + body.ljust(-(-len(body) // 2880) * 2880, b"\0")


@pytest.mark.parametrize(
    ("bits", "kind", "expected"),
    [
        (8, ">u1", np.uint8),
        (16, ">i2", np.int16),
        (32, ">i4", np.int32),
        (-32, ">f4", np.float32),
        (-64, ">f8", np.float64),
    ],
)
def test_every_kind_of_pixel_keeps_its_type_and_value(bits: int, kind: str, expected: type) -> None:
    image = primary_image(_file(PIXELS.astype(kind), bits), "x.fits")
    assert image.dtype == expected
    assert image.tolist() == PIXELS.tolist()


def test_unsigned_numbers_are_what_they_are() -> None:
    """Stored as value - BZERO (4.4.2.5): 0, 32768 and 65535 as -32768, 0 and 32767."""
    stored = np.array([[-32768, 0, 32767]])
    image = primary_image(_file(stored.astype(">i2"), 16, BZERO=32768, BSCALE=1), "x.fits")
    assert image.dtype == np.uint16
    assert image.tolist() == [[0, 32768, 65535]]
    stored = np.array([[-(2**31), -1, 2**31 - 1]])
    image = primary_image(_file(stored.astype(">i4"), 32, BZERO="2147483648.", BSCALE="1.0E0"), "x.fits")
    assert image.dtype == np.uint32
    assert image.tolist() == [[0, 2**31 - 1, 2**32 - 1]]


def test_a_scale_gives_physical_values() -> None:
    """Value = BZERO + BSCALE x stored; the exponent of a double with a D."""
    image = primary_image(_file(PIXELS.astype(">i2"), 16, BZERO="-1.5", BSCALE="2.5D-1"), "x.fits")
    assert image.dtype == np.float64
    assert image.tolist() == (-1.5 + 0.25 * PIXELS).tolist()


def test_the_array_is_the_machines_own_and_row_0_the_files_first() -> None:
    image = primary_image(_file(PIXELS.astype(">i2"), 16), "x.fits")
    assert image.dtype.isnative
    assert image[0].tolist() == [0, 1, 2]


def test_a_third_axis_of_one_plane_is_no_matter() -> None:
    image = primary_image(_file(PIXELS.astype(">i2"), 16, NAXIS=3, NAXIS3=1), "x.fits")
    assert image.shape == (2, 3)


@pytest.mark.parametrize(
    ("cards", "says"),
    [
        ({"BITPIX": 64}, "BITPIX = 64"),
        ({"NAXIS": 0}, "is nothing"),
        ({"NAXIS": 3, "NAXIS3": 3}, "3 x 2 x 3"),
        ({"NAXIS1": 0}, "0 x 2"),
        ({"NAXIS1": 3000}, "cut short"),
        ({"NAXIS2": None}, "no NAXIS2"),
        ({"NAXIS1": "'three'"}, "no whole number"),
        ({"BZERO": "'x'"}, "BZERO"),
        ({"BSCALE": "NaN"}, "BSCALE"),
        ({"BLANK": 128}, "blank pixels"),
    ],
)
def test_what_is_not_read_is_said_in_one_line(cards: dict[str, object], says: str) -> None:
    with pytest.raises(UsageError, match=says) as caught:
        primary_image(_file(PIXELS.astype(">i2"), 16, **cards), "night.fits")
    assert str(caught.value).startswith("night.fits: ")
    assert "\n" not in str(caught.value)


def test_a_blank_value_that_no_pixel_has_is_no_matter() -> None:
    assert primary_image(_file(PIXELS.astype(">i2"), 16, BLANK=-32768), "x.fits").shape == (2, 3)


def test_pixels_that_are_not_finite_are_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        primary_image(_file(np.array([[1.0, np.nan]]).astype(">f4"), -32), "x.fits")


def test_a_header_without_an_end_is_refused() -> None:
    with pytest.raises(UsageError, match="no END"):
        primary_image(_file(PIXELS.astype(">i2"), 16)[:400], "x.fits")


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_a_damaged_file_gives_an_image_or_one_clear_line(data: st.DataObject) -> None:
    content = bytearray(_file(PIXELS.astype(">i2"), 16, BZERO=32768, BSCALE=1))
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, 800))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(UsageError):
        image = primary_image(bytes(content[: data.draw(st.integers(0, len(content)))]), "x.fits")
        assert image.ndim == 2
        assert np.all(np.isfinite(image))


def test_a_fits_file_is_known_by_its_content(tmp_path: Path) -> None:
    path = tmp_path / "frame.dat"
    path.write_bytes(_file(PIXELS.astype(">i2"), 16, BZERO=32768))
    assert read_image(path).tolist() == (PIXELS + 32768).tolist()
