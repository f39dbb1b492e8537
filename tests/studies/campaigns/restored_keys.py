"""Campaign `restored-keys`: restored backups of key folders, while an attacker repeats all recorded frames.

An `Order` is a random sequence of commands, key changes, restarts, backups and restored backups at both ends
of a link. After each step an attacker sends all recorded command frames again. No frame may be admitted
twice, and no nonce may be used twice with a key. A satellite whose primary key is outdated must refuse its
commands until a command of the reserve SPI has set a new key.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flight.link.frames import TELECOMMAND_HEADER, TELEMETRY_MASK
from flight.link.security import (
    COMMAND_SPIS,
    SECURITY_HEADER_BYTES,
    SPI_BYTES,
    TELEMETRY_SPIS,
    Association,
    Gate,
    RefusedError,
    Sealer,
    Vault,
    new_key,
)
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from tests.flight.link.vaults import Ground, gate

STEPS = 60
_SPIS = (*COMMAND_SPIS, *TELEMETRY_SPIS)
_ACTIONS = ("command", "telemetry", "new-key", "restart", "backup", "restore-satellite", "restore-ground")
_ODDS = (0.4, 0.15, 0.1, 0.1, 0.1, 0.1, 0.05)


class Order:
    """A satellite and its ground in one folder, and an attacker who records all frames."""

    def __init__(self, place: Path, seed: tuple[int, ...]) -> None:
        self._place, self._rng = place, np.random.default_rng(seed)
        self._sky, self._ground = place / "sky/keys", place / "ground"
        keys = {spi: new_key() for spi in _SPIS}
        for folder in (self._sky, self._ground):
            folder.mkdir(parents=True)
            for spi, key in keys.items():
                Vault(folder).write(Association(spi, 1, 0, key))
        self._recorded: list[bytes] = []
        self._nonces: set[tuple[bytes, bytes]] = set()
        self._admitted: set[bytes] = set()
        self.facts: dict[str, int] = dict.fromkeys(
            ("frames", "reused", "repeated", "restored", "detected", "rekeyed", "obeyed", "lost"), 0
        )
        self._backups: dict[Path, list[Path]] = {self._sky: [], self._ground: []}
        self._start()

    def run(self) -> None:
        """Run all steps, and then make the satellite reachable again."""
        for _ in range(STEPS):
            self._step(str(self._rng.choice(_ACTIONS, p=_ODDS)))
            for frame in self._recorded:
                self._offer(self._gate, frame)
        self._start()
        self.facts["lost"] += not self._command(COMMAND_SPIS[0])

    def _start(self) -> None:
        self._vault = Vault(self._sky, self._place / "witness")
        self._gate: Gate = gate(self._vault)
        self._sealers = {spi: Sealer(self._vault, spi, TELEMETRY_MASK, 16) for spi in TELEMETRY_SPIS}
        self.facts["detected"] += self._vault.restored

    def _step(self, action: str) -> None:
        if action == "command":
            self._command(int(self._rng.choice(COMMAND_SPIS)))
        elif action == "telemetry":
            spi = int(self._rng.choice(TELEMETRY_SPIS))
            self._note(spi, self._vault, self._sealers[spi].seal(bytes(6), b"live")[0][6:])
        elif action == "new-key":
            self._change_key(int(self._rng.choice(_SPIS)))
        elif action == "restart":
            self._start()
        elif action == "backup":
            for folder, copies in self._backups.items():
                copies.append(self._place / f"{folder.name}-{len(copies)}")
                shutil.copytree(folder, copies[-1])
        else:
            self._restore(self._sky if action == "restore-satellite" else self._ground)

    def _restore(self, folder: Path) -> None:
        copies = self._backups[folder]
        if copies:
            shutil.rmtree(folder)
            shutil.copytree(copies[int(self._rng.integers(len(copies)))], folder)
            self.facts["restored"] += 1
            if folder == self._ground:  # the operator has the current keys, but outdated counters
                for spi in _SPIS:
                    present = self._vault.read(spi)
                    if present is not None:
                        Vault(folder).write(Association(spi, present.generation, 0, present.key))
            # The link is restarted; otherwise it does not read the restored keys.
            elif self._rng.random() < 0.7:
                self._start()

    def _command(self, spi: int) -> bool:
        """Send a command; if the primary key is refused, set a new key by the reserve SPI.

        Return whether the command succeeded.
        """
        if self._send(spi):
            return True
        if self._gate.association(COMMAND_SPIS[0]) is None and self._send(COMMAND_SPIS[1]):
            self._set_key(COMMAND_SPIS[0])
            self.facts["rekeyed"] += 1
        return self._send(spi)

    def _send(self, spi: int) -> bool:
        """Send a command above the highest counter, as the telemetry reports it to the ground."""
        vault, present = Vault(self._ground), self._gate.association(spi)
        own = vault.read(spi)
        assert own is not None
        if present is not None and own.unused < present.unused:
            vault.write(Association(spi, own.generation, present.unused, own.key))
        frame = Ground(vault, spi).frame(b"command")
        self._note(spi, vault, frame[TELECOMMAND_HEADER.size :])
        self._recorded.append(frame)
        return self._offer(self._gate, frame)

    def _change_key(self, spi: int) -> None:
        carrier = COMMAND_SPIS[spi != TELEMETRY_SPIS[0]]
        if self._command(carrier):
            self._set_key(spi)

    def _set_key(self, spi: int) -> None:
        own = Vault(self._ground).read(spi)
        assert own is not None
        changed = Association(spi, own.generation + 1, 0, new_key())
        if spi in COMMAND_SPIS:
            assert self._gate.replace_key(spi, changed.generation, changed.key)
        else:
            assert self._sealers[spi].replace_key(changed.generation, changed.key)
        Vault(self._ground).write(changed)

    def _note(self, spi: int, vault: Vault, protected: bytes) -> None:
        """Record the nonce of a frame under its key."""
        entry = vault.read(spi)
        assert entry is not None
        nonce = (entry.key, protected[SPI_BYTES:SECURITY_HEADER_BYTES])
        self.facts["reused"] += nonce in self._nonces
        self.facts["frames"] += 1
        self._nonces.add(nonce)

    def _offer(self, receiver: Gate, frame: bytes) -> bool:
        try:
            receiver.admit(frame)
        except RefusedError:
            return False
        self.facts["repeated"] += frame in self._admitted
        self.facts["obeyed"] += frame not in self._admitted
        self._admitted.add(frame)
        return True


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` orders."""
    return [Case(str(number), (seed, number), {}) for number in range(runs)]


def run(case: Case) -> Result:
    """Run all steps of one random sequence (`Order`), and return its counts."""
    with tempfile.TemporaryDirectory() as name:
        order = Order(Path(name), case.seed)
        order.run()
        return dict(order.facts)


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return the sums of the counts over all random sequences."""
    del folder
    facts = {name: sum(int(result[name]) for result in results) for name in results[0]}
    return summary({"orders": len(results), **facts})


RESTORED_KEYS = Campaign(
    "restored-keys",
    "restored backups of key folders: no nonce is reused, and no old command is obeyed",
    cases,
    run,
    summarise,
    default_runs=20,
)
