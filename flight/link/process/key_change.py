"""Changes a key of the satellite's end by a directive."""

from __future__ import annotations

from collections.abc import Mapping

from flight.link.process.directives import NewKey
from flight.link.security.associations import COMMAND_SPIS, TELEMETRY_SPIS, Vault
from flight.link.security.gate import Gate, Sealer


def change_key(change: NewKey, vault: Vault, gate: Gate, sealers: Mapping[int, Sealer]) -> str:
    """Change a key; return why not, empty when done."""
    if change.spi not in (*COMMAND_SPIS, *TELEMETRY_SPIS):
        return f"there is no SPI {change.spi}"
    before = vault.read(change.spi)
    if before is not None and change.generation != before.generation + 1:
        return f"the key of SPI {change.spi} is of generation {before.generation}"
    if change.spi in COMMAND_SPIS:
        done = gate.replace_key(change.spi, change.generation, change.key)
    else:
        done = sealers[change.spi].replace_key(change.generation, change.key)
    return "" if done else "the key could not be stored"
