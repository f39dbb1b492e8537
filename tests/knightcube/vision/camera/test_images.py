"""Tests of image files of each supported format, written by Pillow, by the test, or by the vision worker."""

from __future__ import annotations

import contextlib
import io
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knightcube.astro.arrays import Image
from knightcube.errors import UsageError
from knightcube.vision.camera.images import (
    KeptFrames,
    facts_of,
    fits_image,
    grey_stretch,
    keep_frame,
    portable_grey_map,
    read_image,
    stated_exposure,
    write_picture,
)
from knightcube.vision.frame import grey_image
from tests.support.fits_files import fits_file

pillow = pytest.importorskip("PIL.Image", reason="Pillow, the extra `images`, is not installed")

SKY = Path(__file__).resolve().parents[4].parent / "shared" / "data" / "sky"
RNG = np.random.default_rng(11)
EIGHT = RNG.integers(0, 256, (13, 21)).astype(np.uint8)
SIXTEEN = RNG.integers(0, 65_536, (13, 21)).astype(np.uint16)


def _tiff(pixels: Image, order: str, photometric: int = 1, channels: int = 1) -> bytes:
    """Return an uncompressed 16-bit TIFF 6.0 file of `pixels` in byte order "<" or ">"."""
    rows, columns = pixels.shape[:2]
    body = pixels.astype(order + "u2").tobytes()
    tags = [
        (256, 3, 1, columns),
        (257, 3, 1, rows),
        (258, 3, 1, 16),
        (259, 3, 1, 1),
        (262, 3, 1, photometric),
        (273, 4, 1, 8),
        (277, 3, 1, channels),
        (278, 3, 1, rows),
        (279, 4, 1, len(body)),
    ]
    entries = b""
    for tag, kind, count, value in tags:
        # A value of two bytes is stored in the first two of the four bytes.
        form = "HHIHxx" if kind == 3 else "HHII"
        entries += struct.pack(order + form, tag, kind, count, value)
    mark = b"II" if order == "<" else b"MM"
    start = struct.pack(order + "2sHI", mark, 42, 8 + len(body))
    return start + body + struct.pack(order + "H", len(tags)) + entries + bytes(4)


def _png(pixels: Image, colour_type: int, channels: int) -> bytes:
    """Return a 16-bit PNG file in which all `channels` are equal to `pixels`."""

    def chunk(name: bytes, content: bytes) -> bytes:
        check = zlib.crc32(name + content)
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", check)

    rows, columns = pixels.shape
    lines = np.repeat(pixels.astype(">u2"), channels, axis=1)
    raw = b"".join(b"\0" + line.tobytes() for line in lines)
    head = struct.pack(">IIBBBBB", columns, rows, 16, colour_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("name", ["a.png", "a.tiff"])
@pytest.mark.parametrize("pixels", [EIGHT, SIXTEEN], ids=["8 bits", "16 bits"])
def test_grey_pixels_come_back_as_they_were_written(tmp_path: Path, name: str, pixels: Image) -> None:
    path = tmp_path / name
    pillow.fromarray(pixels).save(path)
    image = read_image(path)
    assert image.dtype == pixels.dtype
    assert np.array_equal(image, pixels)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_16_bit_tiff_is_right_in_either_byte_order(tmp_path: Path, order: str) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(_tiff(SIXTEEN, order))
    image = read_image(path)
    assert image.dtype == np.uint16
    assert image.dtype.isnative
    assert np.array_equal(image, SIXTEEN)


def test_a_16_bit_png_made_by_hand_is_right(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(_png(SIXTEEN, 0, 1))
    assert np.array_equal(read_image(path), SIXTEEN)


def test_a_jpeg_is_read_to_its_compression(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    smooth = np.add.outer(np.arange(64), np.arange(64)).astype(np.uint8)
    pillow.fromarray(smooth).save(path, quality=95)
    image = read_image(path)
    assert image.dtype == np.uint8
    assert np.abs(image.astype(int) - smooth).max() <= 3


@pytest.mark.parametrize(
    ("mode", "name"), [("RGB", "a.png"), ("RGBA", "a.png"), ("RGB", "a.tif"), ("P", "a.png"), ("P", "a.tif")]
)
def test_colour_becomes_luminance(tmp_path: Path, mode: str, name: str) -> None:
    """The luminance of a colour image is 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601)."""
    colours = np.array([[[200, 0, 0], [0, 200, 0], [0, 0, 200], [10, 20, 30]]], dtype=np.uint8)
    # The palette contains all four colours exactly.
    pillow.fromarray(colours).convert(mode, palette=pillow.Palette.ADAPTIVE).save(tmp_path / name)
    image = read_image(tmp_path / name)
    assert image.dtype == np.uint8
    expected = colours[0] @ np.array([0.299, 0.587, 0.114])
    assert image[0] == pytest.approx(expected, abs=0.6)


def test_colours_of_an_array_have_the_luminance_of_the_file(tmp_path: Path) -> None:
    colours = np.random.default_rng(4).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    pillow.fromarray(colours).save(tmp_path / "a.png")
    assert np.abs(grey_image(colours).astype(int) - read_image(str(tmp_path / "a.png"))).max() <= 1
    assert grey_image(colours / 255.0).dtype == np.float64
    grey = colours[..., 0]
    assert grey_image(grey) is grey


def test_transparent_pixels_keep_their_brightness(tmp_path: Path) -> None:
    picture = np.dstack([EIGHT, EIGHT, EIGHT, np.zeros_like(EIGHT)])
    pillow.fromarray(picture).save(tmp_path / "a.png")
    assert np.array_equal(read_image(tmp_path / "a.png"), EIGHT)


def test_one_bit_becomes_black_and_white(tmp_path: Path) -> None:
    pillow.fromarray(EIGHT > 127).save(tmp_path / "a.png")
    assert np.array_equal(read_image(tmp_path / "a.png"), np.where(EIGHT > 127, 255, 0))


@pytest.mark.parametrize(("colour_type", "channels"), [(2, 3), (6, 4)])
def test_16_bit_colour_becomes_luminance_of_16_bits(tmp_path: Path, colour_type: int, channels: int) -> None:
    """If all channels of a 16-bit image are equal, the luminance equals the count of each channel."""
    path = tmp_path / "a.png"
    path.write_bytes(_png(SIXTEEN, colour_type, channels))
    found = read_image(path)
    assert found.dtype == np.uint16
    assert np.array_equal(found, SIXTEEN)


def test_16_bit_grey_with_transparency_is_refused_rather_than_halved(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(_png(SIXTEEN, 4, 2))
    with pytest.raises(UsageError, match="16-bit colour"):
        read_image(path)


def test_a_bitmap_is_read(tmp_path: Path) -> None:
    pillow.fromarray(EIGHT).save(tmp_path / "a.bmp")
    assert np.array_equal(read_image(tmp_path / "a.bmp"), EIGHT)


def test_an_image_stored_as_a_negative_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(_tiff(SIXTEEN, "<", photometric=0))
    with pytest.raises(UsageError, match="zero is white"):
        read_image(path)


def test_pixels_of_another_kind_are_refused(tmp_path: Path) -> None:
    pillow.fromarray(EIGHT.astype(np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(UsageError, match="convert it to 8 or 16 bit grey"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("content", [b"", b"GIF89a nothing", b"SIMPLE", bytes(5000)])
def test_a_file_that_is_not_an_image_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(UsageError, match="PNG, TIFF, JPEG, BMP, PGM or FITS") as caught:
        read_image(path)
    assert "\n" not in str(caught.value)


def test_a_gif_is_refused(tmp_path: Path) -> None:
    pillow.fromarray(EIGHT).save(tmp_path / "a.gif")
    with pytest.raises(UsageError, match="PNG, TIFF, JPEG, BMP, PGM or FITS"):
        read_image(tmp_path / "a.gif")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.png", tmp_path):
        with pytest.raises(UsageError, match="cannot be read"):
            read_image(path)


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "JPEG"])
def test_a_damaged_file_gives_an_image_or_one_clear_line(tmp_path: Path, kind: str) -> None:
    written = io.BytesIO()
    pillow.fromarray(EIGHT).save(written, kind)
    path, rng, refused = tmp_path / "a", np.random.default_rng(6), 0
    for trial in range(150):
        content = bytearray(written.getvalue())
        if trial % 2:
            del content[int(rng.integers(1, len(content))) :]
        else:
            content[int(rng.integers(0, len(content)))] = int(rng.integers(0, 256))
        path.write_bytes(bytes(content))
        try:
            assert read_image(path).ndim == 2
        except UsageError:
            refused += 1
    assert refused > 60


def test_without_pillow_an_image_asks_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow.fromarray(EIGHT).save(tmp_path / "a.png")
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(UsageError, match="pip install pillow"):
        read_image(tmp_path / "a.png")
    with pytest.raises(UsageError, match="pip install pillow"):
        write_picture(tmp_path / "b.png", grey_stretch(EIGHT))


def test_a_stretch_puts_the_percentiles_at_black_and_white() -> None:
    image = np.arange(10_001, dtype=np.uint16).reshape(73, 137)
    picture = grey_stretch(image, 10.0, 90.0)
    assert picture.shape == (73, 137, 3)
    assert picture.dtype == np.uint8
    assert np.array_equal(picture[..., 0], picture[..., 2])
    grey = picture[..., 0].reshape(-1)
    assert grey[1000] == 0
    assert grey[5000] in (127, 128)
    assert grey[9000] == 255
    assert np.all(np.diff(grey.astype(int)) >= 0)


def test_a_frame_of_one_brightness_is_black() -> None:
    assert grey_stretch(np.full((4, 5), 7)).max() == 0
    with pytest.raises(UsageError, match="percentiles"):
        grey_stretch(np.zeros((4, 5)), 99.0, 1.0)


def test_a_written_image_can_be_read_again(tmp_path: Path) -> None:
    picture = grey_stretch(SIXTEEN)
    picture[3, 4] = (255, 0, 0)
    write_picture(tmp_path / "found.png", picture)
    with pillow.open(tmp_path / "found.png") as again:
        assert again.mode == "RGB"
        assert np.array_equal(np.asarray(again), picture)
    with pytest.raises(UsageError, match="cannot be written"):
        write_picture(tmp_path / "no" / "found.png", picture)


@pytest.mark.skipif(not SKY.is_dir(), reason="the photographs of shared/data/sky are not here")
@pytest.mark.parametrize(
    ("name", "shape", "kind"),
    [
        ("esa_alt40_azi45.tiff", (768, 1024), np.uint16),
        ("may8_100ms_gain40_0.png", (1040, 1392), np.uint8),
        ("orion2.jpg", (507, 507), np.uint8),
        ("polar_05sec.jpg", (960, 1280), np.uint8),
    ],
)
def test_photographs_of_the_sky_are_dark_with_bright_stars(
    name: str, shape: tuple[int, int], kind: type
) -> None:
    image = read_image(SKY / name)
    assert image.shape == shape
    assert image.dtype == kind
    # With a wrong byte order, the 16-bit frames would be noise, in which neighbouring pixels differ.
    assert np.median(image) < 0.25 * image.max()
    smooth = np.abs(np.diff(image.astype(float), axis=1))
    assert np.median(smooth) < 0.05 * image.max()


PIXELS = np.array([[0, 1, 2], [127, 128, 255]])


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
    image = fits_image(fits_file(PIXELS.astype(kind), bits), "x.fits")
    assert image.dtype == expected
    assert image.tolist() == PIXELS.tolist()


def test_unsigned_integers_keep_their_values() -> None:
    """Unsigned integers keep their values: 0, 32768 and 65535 are stored as -32768, 0 and 32767.

    FITS 4.4.2.5 stores the value minus BZERO.
    """
    stored = np.array([[-32768, 0, 32767]])
    image = fits_image(fits_file(stored.astype(">i2"), 16, BZERO=32768, BSCALE=1), "x.fits")
    assert image.dtype == np.uint16
    assert image.tolist() == [[0, 32768, 65535]]
    stored = np.array([[-(2**31), -1, 2**31 - 1]])
    image = fits_image(fits_file(stored.astype(">i4"), 32, BZERO="2147483648.", BSCALE="1.0E0"), "x.fits")
    assert image.dtype == np.uint32
    assert image.tolist() == [[0, 2**31 - 1, 2**32 - 1]]


def test_a_scale_gives_physical_values() -> None:
    """The value of a pixel is BZERO + BSCALE times the stored value; the exponent of a double may use D."""
    image = fits_image(fits_file(PIXELS.astype(">i2"), 16, BZERO="-1.5", BSCALE="2.5D-1"), "x.fits")
    assert image.dtype == np.float64
    assert image.tolist() == (-1.5 + 0.25 * PIXELS).tolist()


def test_the_array_has_native_byte_order_and_starts_with_the_first_row() -> None:
    image = fits_image(fits_file(PIXELS.astype(">i2"), 16), "x.fits")
    assert image.dtype.isnative
    assert image[0].tolist() == [0, 1, 2]


def test_a_third_axis_of_one_plane_is_accepted() -> None:
    image = fits_image(fits_file(PIXELS.astype(">i2"), 16, NAXIS=3, NAXIS3=1), "x.fits")
    assert image.shape == (2, 3)


@pytest.mark.parametrize(
    ("cards", "says"),
    [
        ({"BITPIX": 64}, "BITPIX = 64"),
        ({"NAXIS": 0}, "is nothing"),
        ({"NAXIS": 3, "NAXIS3": 4}, "3 x 2 x 4"),
        ({"NAXIS": 3, "NAXIS1": 999, "NAXIS3": 3}, "last of 999 x 2 x 3"),
        ({"NAXIS": 1000}, "NAXIS = 1000"),
        ({"NAXIS1": -3}, "NAXIS1 = -3"),
        ({"ROWORDER": "'UP'"}, "ROWORDER = 'UP'"),
        ({"BSCALE": "1E306"}, "BSCALE = 1e"),
        ({"NAXIS1": 0}, "0 x 2"),
        ({"NAXIS1": 3000}, "cut short"),
        ({"NAXIS2": None}, "no NAXIS2"),
        ({"NAXIS1": "'three'"}, "not an integer"),
        ({"BZERO": "'x'"}, "BZERO"),
        ({"BSCALE": "NaN"}, "BSCALE"),
        ({"BLANK": 128}, "blank pixels"),
    ],
)
def test_an_unsupported_file_is_reported_in_one_line(cards: dict[str, object], says: str) -> None:
    with pytest.raises(UsageError, match=says) as caught:
        fits_image(fits_file(PIXELS.astype(">i2"), 16, **cards), "night.fits")
    assert str(caught.value).startswith("night.fits: ")
    assert "\n" not in str(caught.value)


def test_a_blank_value_that_no_pixel_has_is_accepted() -> None:
    assert fits_image(fits_file(PIXELS.astype(">i2"), 16, BLANK=-32768), "x.fits").shape == (2, 3)


def test_pixels_that_are_not_finite_are_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        fits_image(fits_file(np.array([[1.0, np.nan]]).astype(">f4"), -32), "x.fits")


def test_a_header_without_an_end_is_refused() -> None:
    with pytest.raises(UsageError, match="no END"):
        fits_image(fits_file(PIXELS.astype(">i2"), 16)[:400], "x.fits")


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_a_damaged_fits_file_gives_an_image_or_one_clear_line(data: st.DataObject) -> None:
    content = bytearray(fits_file(PIXELS.astype(">i2"), 16, BZERO=32768, BSCALE=1))
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, 800))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(UsageError):
        image = fits_image(bytes(content[: data.draw(st.integers(0, len(content)))]), "x.fits")
        assert image.ndim == 2
        assert np.all(np.isfinite(image))


def test_a_fits_file_is_known_by_its_content(tmp_path: Path) -> None:
    path = tmp_path / "frame.dat"
    path.write_bytes(fits_file(PIXELS.astype(">i2"), 16, BZERO=32768))
    assert read_image(path).tolist() == (PIXELS + 32768).tolist()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_stored_frames_can_be_read_by_another_library(tmp_path: Path, kind: type[np.unsignedinteger]) -> None:
    pixels = (np.arange(60).reshape(6, 10) * (1000 if kind is np.uint16 else 4)).astype(kind)
    folder = tmp_path / "frames"
    for number in range(5):
        keep_frame(KeptFrames(folder, 3, f"frame-{number:08d}"), pixels, {"stars": "solved"})
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"frame-{number:08d}.pgm" for number in (2, 3, 4)]
    with pillow.open(folder / names[0]) as picture:
        np.testing.assert_array_equal(np.asarray(picture), pixels)
    assert facts_of((folder / names[0]).read_bytes()) == {"stars": "solved"}


def test_a_full_disk_loses_only_the_stored_frame(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    keep_frame(KeptFrames(tmp_path / "file" / "frames", 3, "a"), np.zeros((2, 2), np.uint8), {})
    with pytest.raises(ValueError, match="no kept frame"):
        facts_of(b"P5\n2 2\n255\n")


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_frame_that_a_flight_kept_is_read_with_its_exposure(
    tmp_path: Path, kind: type[np.unsignedinteger]
) -> None:
    pixels = np.arange(20 * 30).reshape(20, 30).astype(kind)
    path = tmp_path / "frame.pgm"
    path.write_bytes(portable_grey_map(pixels, {"exposure_s": 0.4}))
    assert read_image(path).dtype == kind
    assert np.array_equal(read_image(path), pixels)
    assert stated_exposure(path) == 0.4
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(UsageError, match="ends before the last of 30 x 20 pixels"):
        read_image(path)
    path.write_bytes(b"P5 # by another program\n30 20 # size\n4095\n" + pixels.astype(">u2").tobytes())
    assert np.array_equal(read_image(path), pixels)
    assert stated_exposure(path) is None
    path.write_bytes(b"P5\n30 0\n255\n")
    with pytest.raises(UsageError, match="its PGM header has no columns, rows and largest count"):
        read_image(path)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tiff"])
def test_a_photograph_is_rotated_as_its_metadata_state(tmp_path: Path, name: str, orientation: int) -> None:
    """A photograph is rotated as the orientation in its metadata states.

    The marks are then at the top left. For orientations from 5 on, the long side of the stored image is
    vertical.
    """
    pixels = np.zeros((32, 48), dtype=np.uint8)
    pixels[:8, :24], pixels[16:24, 8:16] = 200, 100
    # Each orientation defines the sides of the scene to which row 0 and column 0 of the stored image belong
    # (EXIF 2.3, section 4.6.4).
    stored = {
        1: pixels,
        2: pixels[:, ::-1],
        3: pixels[::-1, ::-1],
        4: pixels[::-1],
        5: pixels.T,
        6: np.rot90(pixels),
        7: pixels[::-1, ::-1].T,
        8: np.rot90(pixels, -1),
    }
    exif = pillow.Exif()
    exif[0x0112] = orientation
    pillow.fromarray(np.ascontiguousarray(stored[orientation])).save(tmp_path / name, exif=exif)
    if name == "a.tiff" and orientation >= 5:
        with pytest.raises(UsageError, match=f"Orientation = {orientation}"):
            read_image(tmp_path / name)
        return
    image = read_image(tmp_path / name)
    assert image.shape == (32, 48)
    assert np.abs(image.astype(int) - pixels).max() <= (30 if name == "a.jpg" else 0)
    if name != "a.tiff":  # Pillow itself rotates TIFF images
        detector = read_image(tmp_path / name, upright=False)
        assert np.abs(detector.astype(int) - stored[orientation]).max() <= (30 if name == "a.jpg" else 0)


def test_the_exposure_time_is_that_of_the_metadata(tmp_path: Path) -> None:
    pixels = np.zeros((32, 48), dtype=np.uint8)
    exif = pillow.Exif()
    exif[0x8769] = {0x829A: 0.25}
    pillow.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif)
    pillow.fromarray(pixels).save(tmp_path / "plain.png")
    write_picture(tmp_path / "a.png", pixels, 0.3)
    write_picture(tmp_path / "b.png", pixels)
    (tmp_path / "a.fits").write_bytes(fits_file(pixels, 8, EXPTIME=1.5))
    (tmp_path / "b.fits").write_bytes(fits_file(pixels, 8, EXPTIME=0.0))
    double = f"{'EXPTIME':8}= {'2.5D-1':>20}".encode().ljust(80)
    content = fits_file(pixels, 8, EXPTIME=0.25)
    begin = content.index(b"EXPTIME")
    (tmp_path / "d.fits").write_bytes(content[:begin] + double + content[begin + 80 :])
    (tmp_path / "a.bin").write_bytes(b"no image")
    found = {path.name: stated_exposure(path) for path in tmp_path.iterdir()}
    expected = {"a.jpg": 0.25, "a.png": 0.3, "a.fits": 1.5, "d.fits": 0.25}
    assert found == expected | dict.fromkeys(["plain.png", "b.png", "b.fits", "a.bin"])
