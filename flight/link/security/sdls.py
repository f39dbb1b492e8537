"""Protected frames: security header (SPI 2 | IV 12), AES-256-GCM ciphertext, MAC 16.

CCSDS 355.0-B-2 with AES-256-GCM in both directions. The IV is the frame's counter, which nobody uses twice
under a key. The MAC covers the virtual channel, the SPI and the data; the IV takes part as the nonce. These
are the bits that Yamcs covers.
"""

from __future__ import annotations

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

SPI_BYTES = 2
IV_BYTES = 12
MAC_BYTES = 16
SECURITY_HEADER_BYTES = SPI_BYTES + IV_BYTES
OVERHEAD_BYTES = SECURITY_HEADER_BYTES + MAC_BYTES
KEY_BYTES = 32

_NO_IV = bytes(IV_BYTES)


def _authenticated(header: bytes, mask: bytes, spi: bytes) -> bytes:
    masked = int.from_bytes(header, "big") & int.from_bytes(mask, "big")
    return masked.to_bytes(len(header), "big") + spi + _NO_IV


def protect(cipher: AESGCM, spi: int, counter: int, header: bytes, mask: bytes, data: bytes) -> bytes:
    """Return header, security header, ciphertext and MAC; `mask` has the bits of the header that count."""
    index, iv = spi.to_bytes(SPI_BYTES, "big"), counter.to_bytes(IV_BYTES, "big")
    return header + index + iv + cipher.encrypt(iv, data, _authenticated(header, mask, index))


def spi_of(protected: bytes) -> int:
    """Return the index of the association that protects a frame, -1 of one that is too short."""
    return int.from_bytes(protected[:SPI_BYTES], "big") if len(protected) >= OVERHEAD_BYTES else -1


def counter_of(protected: bytes) -> int:
    """Return the counter of a frame; believe it only after `unprotect`."""
    return int.from_bytes(protected[SPI_BYTES:SECURITY_HEADER_BYTES], "big")


def unprotect(cipher: AESGCM, header: bytes, mask: bytes, protected: bytes) -> bytes | None:
    """Return the data of a frame, from the security header on; None unless the MAC is right."""
    index, iv = protected[:SPI_BYTES], protected[SPI_BYTES:SECURITY_HEADER_BYTES]
    try:
        return cipher.decrypt(iv, protected[SECURITY_HEADER_BYTES:], _authenticated(header, mask, index))
    except InvalidTag:
        return None
