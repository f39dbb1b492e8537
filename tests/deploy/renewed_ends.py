"""A board that is updated, its link and its ground station in one process. Services start as on a board."""

from __future__ import annotations

import json
import re
from pathlib import Path

from flight.app.flight import fly
from flight.app.run import RunRequest
from flight.app.service import FlownConfig, accepted_config
from flight.link.events import Mode
from flight.link.process.directives import Activate, Listing
from flight.schema.reader import parse
from ground.link.commanding import sha256_of
from knightcube.errors import KnightCubeError, UsageError
from tests.deploy.renewed_board import RenewedBoard
from tests.flight.link.process.filed_ends import FiledEnds
from tests.support.flights import CONFIG

KEYS, SOCKET = "/var/lib/knightcube-link/keys", "/run/knightcube/commands"
FLIGHT, LINK, SAFE = "knightcube.service", "knightcube-link.service", "knightcube-safe.service"


def linked_text() -> str:
    """Return a simulated configuration with a link and no camera, because building a sky index is slow."""
    text = CONFIG.read_text(encoding="utf-8")
    text = re.sub(r"^camera:.*?^(?=\S)", "camera: none\n", text, flags=re.MULTILINE | re.DOTALL)
    link = json.dumps({"keys": KEYS, "udp": "127.0.0.1:5000"})
    commands = json.dumps({"socket": SOCKET})
    return f"{text}\ncommands: {commands}\nlink: {link}\n"


class RenewedEnds(FiledEnds):
    """A satellite whose software can be updated, and its ground station.

    Attributes:
        board: files of the satellite.
        reacts: name of the configuration whose flight enters the mode SAFE because of an event.
        crashes: label of the release whose flight crashes at its start.
    """

    def __init__(self, board: RenewedBoard, seed: int) -> None:
        """Use a copy of the files of a board."""
        self.board, self.reacts, self.crashes = board, "", "crashes"
        self.renewal = board.own / "status"
        place = board.place / "link"
        place.mkdir()
        board.link.rename(place / "keys-of-board")
        super().__init__(place, up_rate=1e6, seed=seed)
        # On the board, the folder `keys` lies in the state folder of the link.
        (place / "keys").rename(board.link)
        (place / "keys-of-board").rename(board.link / "moved")
        (place / "keys").symlink_to(board.link)
        self.up = {FLIGHT: True, LINK: True}
        self.restart()

    def activate(self, bundle: Path, kind: str, hours: float) -> None:
        """Uplink a bundle and activate it."""
        self.session.put(bundle, f"{kind}/{bundle.name}", self.clock.now_ns())
        self.until_closed()
        self.ask(Activate(f"received/{kind}/{bundle.name}", sha256_of(bundle), hours, 0))
        self.turn(0.5)

    def answers(self) -> bool:
        """Return whether the link executes a test command."""
        return self.up[LINK] and self.command(Listing()) == "completed"

    def services(self) -> None:
        """Start flight and link as systemd does, if their restart is requested."""
        if not self.board.restarted():
            return
        name = self._flown()
        self.up = {FLIGHT: bool(name), LINK: self._linked()}
        for unit, up in self.up.items():
            self.board.set_active(unit, up)
        self.board.set_active(SAFE, not name)
        self.restart()
        if name and name == self.reacts:
            self.record(self.mode_packet(Mode.SAFE, "reaction safe"))

    def flown_release(self) -> str:
        """Return the label of the running release, or an empty string if its flight crashes at its start."""
        label = self.board.release()
        return "" if label == self.crashes else label

    def _flown(self) -> str:
        """Return the name of the configuration in use, or "" if the flight crashes at its start."""
        state = self.board.place / "state"
        state.mkdir(exist_ok=True)
        if not self.flown_release():
            return ""
        try:
            chosen = accepted_config(self.board.config, {"STATE_DIRECTORY": str(state)})
            path = state / "flight.yaml"
            path.write_text(chosen.text.replace(SOCKET, str(state / "socket")), encoding="utf-8")
            run = state / f"run-{len(list(state.iterdir()))}"
            fly(RunRequest(path, run, duration=0.1))
        except (KnightCubeError, UsageError):
            return ""
        FlownConfig(chosen.text, state).keep()
        return parse(chosen.text, str(path)).name

    def _linked(self) -> bool:
        """Return whether the link opens its line."""
        try:
            chosen = accepted_config(self.board.config, {"STATE_DIRECTORY": str(self.board.place / "state")})
            link = parse(chosen.text, "flight.yaml").link
        except (KnightCubeError, UsageError):
            return False
        return link is not None and link.keys == KEYS
