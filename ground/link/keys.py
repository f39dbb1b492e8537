"""Makes the keys of a link: a folder for the satellite and a folder for the ground, with the same keys."""

from __future__ import annotations

from pathlib import Path

from flight.link.security import COMMAND_SPIS, COPIES, TELEMETRY_SPIS, Association, Vault, new_key
from knightcube.errors import UsageError

ENDS = ("satellite", "ground")
_PRIVATE = 0o700


def make_keys(folder: Path) -> list[Path]:
    """Make new keys in a folder that does not exist; return the folders of both ends. Raises UsageError."""
    keys = {spi: new_key() for spi in (*COMMAND_SPIS, *TELEMETRY_SPIS)}
    try:
        folder.mkdir(mode=_PRIVATE, parents=True)
    except FileExistsError as error:
        raise UsageError(f"{folder} exists: keys are never overwritten, give another folder") from error
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {error.strerror or error}") from error
    ends = [folder / end for end in ENDS]
    for end in ends:
        end.mkdir(mode=_PRIVATE)
        vault = Vault(end)
        for spi, key in keys.items():
            if vault.write(Association(spi, 1, 0, key)) != len(COPIES):
                raise UsageError(f"{end}: keys cannot be written")
    return ends
