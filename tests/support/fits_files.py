"""FITS images that are built card by card by the FITS Standard 4.0."""

from __future__ import annotations

from knightcube.astro.arrays import Image


def _card(keyword: str, value: object) -> bytes:
    return f"{keyword:<8}= {value!s:>20} / of the test".ljust(80).encode("ascii")


def fits_file(stored: Image, bits: int, **cards: object) -> bytes:
    """Return a FITS file of `stored` (rows, columns).

    `cards` are added to the mandatory header or replace its cards.
    """
    header: dict[str, object] = {"SIMPLE": "T", "BITPIX": bits, "NAXIS": 2}
    header |= {"NAXIS1": stored.shape[1], "NAXIS2": stored.shape[0]} | cards
    text = b"".join(_card(keyword, value) for keyword, value in header.items() if value is not None)
    text += b"COMMENT   END = 3 does not end the header".ljust(80) + b"END".ljust(80)
    body = stored.tobytes()
    return text.ljust(-(-len(text) // 2880) * 2880) + body.ljust(-(-len(body) // 2880) * 2880, b"\0")
