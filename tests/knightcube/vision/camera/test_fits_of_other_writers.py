"""Tests with FITS files that astropy has written, and with changed headers."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knightcube.errors import UsageError
from knightcube.vision.camera.images import fits_image, read_image, rows_reversed

fits = pytest.importorskip("astropy.io.fits", reason="astropy is of the extra `test`")

RNG = np.random.default_rng(5)
COLOURS = RNG.integers(0, 60_000, (3, 20, 30)).astype(np.uint16)
GREY = COLOURS[1]


def _written(*units: object) -> bytes:
    """Return the bytes of a FITS file that astropy writes from some header data units."""
    out = io.BytesIO()
    fits.HDUList(list(units)).writeto(out)
    return out.getvalue()


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("extension", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_an_image_is_read_from_an_extension_and_from_gzip(
    tmp_path: Path, kind: type, extension: bool, packed: bool
) -> None:
    pixels = (GREY % 120).astype(kind)
    table = fits.BinTableHDU.from_columns([fits.Column("flux", "E", array=np.arange(700.0))])
    units = [fits.PrimaryHDU(), table, fits.ImageHDU(pixels)] if extension else [fits.PrimaryHDU(pixels)]
    content = _written(*units)
    path = tmp_path / "night.fits"
    path.write_bytes(gzip.compress(content) if packed else content)
    image = read_image(path)
    assert image.dtype == kind
    assert image.tolist() == pixels.tolist()


@pytest.mark.parametrize(("order", "step"), [("TOP-DOWN", 1), ("BOTTOM-UP", -1)])
def test_row_0_is_the_top_row(tmp_path: Path, order: str, step: int) -> None:
    unit = fits.PrimaryHDU(GREY)
    unit.header["ROWORDER"] = order
    path = tmp_path / "night.fits"
    path.write_bytes(_written(unit))
    assert read_image(path).tolist() == GREY[::step].tolist()
    assert rows_reversed(path) == (step < 0)


def test_three_planes_of_colour_become_luminance() -> None:
    image = fits_image(_written(fits.PrimaryHDU(COLOURS)), "x.fits")
    expected = 0.299 * COLOURS[0] + 0.587 * COLOURS[1] + 0.114 * COLOURS[2]
    assert image.dtype == np.uint16
    assert np.abs(image - expected).max() <= 0.51


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (_written(fits.PrimaryHDU(), fits.CompImageHDU(GREY)), "tile-compressed.*RICE_1.*funpack"),
        (_written(fits.PrimaryHDU(np.zeros((4, 5, 6), np.uint8))), "6 x 5 x 4"),
        (_written(fits.PrimaryHDU()), "no extension has an image"),
    ],
)
def test_other_files_are_refused_with_the_cause(content: bytes, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        fits_image(content, "x.fits")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (gzip.compress(b"text", mtime=0), "not a FITS image"),
        (gzip.compress(_written(fits.PrimaryHDU(GREY)))[:300], "is damaged"),
    ],
)
def test_a_gzip_file_without_an_image_is_refused(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "a.gz"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=complaint):
        read_image(path)


KEYWORDS = ("BITPIX", "NAXIS", "NAXIS1", "NAXIS2", "NAXIS3", "BZERO", "BSCALE", "BLANK", "ROWORDER")
VALUES = st.one_of(
    st.integers(-(10**19), 10**19).map(str),
    st.integers(-70, 70).map(str),
    st.floats().map(str),
    st.sampled_from(["T", "'x'", "", "1E400", "-1D308", "(1, 2)", "'BOTTOM-UP'"]),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(KEYWORDS), VALUES), min_size=1, max_size=3))
def test_a_wrong_value_in_a_header_is_read_or_named_in_one_line(changes: list[tuple[str, str]]) -> None:
    """A file with a wrong header value is read, or refused in one line that names the problem.

    The line names the changed keyword, its value, or the resulting size of the image.
    """
    header: dict[str, str] = {"SIMPLE": "T", "BITPIX": "16", "NAXIS": "2", "NAXIS1": "30", "NAXIS2": "20"}
    header |= dict(changes)
    text = "".join(f"{key:<8}= {value:>20}"[:80].ljust(80) for key, value in header.items()) + "END".ljust(80)
    content = text.ljust(2880).encode() + GREY.astype(">i2").tobytes().ljust(2880, b"\0")
    try:
        image = fits_image(content, "x.fits")
    except UsageError as error:
        said = str(error)
        assert said.startswith("x.fits: ")
        assert "\n" not in said
        sizes = " x " in said or "image is nothing" in said
        assert sizes or any(f"{key}" in said for key, _ in changes) or "NAXIS" in said, said
    else:
        assert image.ndim == 2
        assert np.all(np.isfinite(image))
