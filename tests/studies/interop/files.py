"""File transfers between the CFDP service of Yamcs and the satellite, through link and gateway, with losses.

Link, gateway and Yamcs are separate processes, with a relay between link and gateway that loses frames in
both directions.
The satellite is commanded to send one file, and Yamcs uploads another one. The study prints one JSON line for
each loss
probability: whether both files arrived complete (SHA-256) and were closed at both ends, and the durations
(s). With `--endings` each side cancels a transfer in each direction instead, and one transfer is suspended on
board and resumed; there is one JSON line for each. The exit status is 1 if a transfer does not end as
required. The study is skipped with a message if Java or the bundle is missing.
"""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ground.yamcs import CFDP, DOWN_BUCKET, INSTANCE, UP_BUCKET, write
from tests.studies.command import Seed, command, say
from tests.studies.interop.lossy_relay import lossy_relay
from tests.studies.interop.yamcs import until
from tests.support.flooded_flight import free_port as free_udp_port
from tests.support.linked_board import write_linked_config
from tests.support.linked_flight import free_port, service
from tests.support.yamcs_server import Yamcs, missing, serving

_RATE = 200_000
_LONGEST_S = 1800.0
_ASK_S = 10.0
_RUN = "run-000001"
_NAME = "dump.bin"
_TRANSFERS = f"/filetransfer/{INSTANCE}/{CFDP}/transfers"


def transferred(place: Path, size: int, loss: float, seed: int) -> Iterator[dict[str, Any]]:
    """Transfer a file in each direction, and yield the results."""
    data = np.random.default_rng(seed).bytes(size)
    (place / "runs" / _RUN).mkdir(parents=True)
    (place / "runs" / _RUN / _NAME).write_bytes(data)
    http = free_port()
    with _opened(place, loss, seed) as gateway:
        folder = place / "yamcs"
        write(folder, gateway, http, keys=place / "keys" / "ground")
        with serving(folder, http) as server:
            until(server.link_up, 60.0)
            down = _down(server, place, hashlib.sha256(data).digest())
            up = _up(server, place, data)
            states = sorted(one["state"] for one in _transfers(server))
    left = sorted(path.name for path in (place / "keys" / "files" / "transfers").glob("*-*.json"))
    closed = states == ["COMPLETED", "COMPLETED"] and not left
    sound = down["down_whole"] and up["up_whole"] and closed
    facts = {"loss": loss, "bytes": size, **down, **up, "closed": closed, "sound": sound}
    yield {**facts, "states": states, "open": left}


def ended(place: Path, size: int, loss: float, seed: int) -> Iterator[dict[str, Any]]:
    """Cancel a transfer in each direction from each side, and suspend one; yield the result of each."""
    (place / "runs" / _RUN).mkdir(parents=True)
    (place / "runs" / _RUN / _NAME).write_bytes(np.random.default_rng(seed).bytes(size))
    http = free_port()
    with _opened(place, loss, seed) as gateway:
        folder = place / "yamcs"
        write(folder, gateway, http, keys=place / "keys" / "ground")
        (folder / UP_BUCKET / "release.whl").write_bytes(np.random.default_rng(seed).bytes(size))
        with serving(folder, http) as server:
            until(server.link_up, 60.0)
            for way in ("down", "up"):
                for by in ("yamcs", "satellite"):
                    one = _begun(server, way)
                    if by == "yamcs":
                        server.raw(f"{_TRANSFERS}/{one['id']}:cancel", {})
                    else:
                        server.command("cancel-file", _number(one))
                    yield {"way": way, "cancelled_by": by, **_ended(server, place, one["id"], "FAILED")}
            one = _begun(server, "down")
            server.command("suspend-file", _number(one))
            time.sleep(_ASK_S)
            before = _transfer(server, one["id"])["sizeTransferred"]
            time.sleep(_ASK_S)
            rested = _transfer(server, one["id"])["sizeTransferred"] == before != str(size)
            server.command("resume-file", _number(one))
            yield {"suspended": rested, **_ended(server, place, one["id"], "COMPLETED")}


def _begun(server: Yamcs, way: str) -> dict[str, Any]:
    """Start a transfer, and return it after its first data have arrived."""
    known = {one["id"] for one in _transfers(server)}
    if way == "up":
        _send_up(server)
    begun: list[dict[str, Any]] = []
    until = time.monotonic() + _LONGEST_S
    asked = 0.0
    while not begun and time.monotonic() < until:
        if way == "down" and time.monotonic() - asked > _ASK_S:
            asked = time.monotonic()
            server.command("send-file", {"entity": "another-ground-station", "name": f"log/{_RUN}/{_NAME}"})
        begun = [one for one in _transfers(server) if one["id"] not in known and int(one["sizeTransferred"])]
        time.sleep(0.3)
    return begun[0]


def _ended(server: Yamcs, place: Path, transfer: str, wanted: str) -> dict[str, Any]:
    """Wait until both ends close a transfer; return its state and the satellite's open transfers."""
    stored = place / "keys" / "files" / "transfers"
    until(lambda: _transfer(server, transfer)["state"] in {"COMPLETED", "FAILED"}, _LONGEST_S)
    until(lambda: not list(stored.glob("*-*.json")), 120.0)
    state, left = _transfer(server, transfer)["state"], sorted(path.name for path in stored.glob("*-*.json"))
    return {"state": state, "open": left, "sound": state == wanted and not left}


def _transfer(server: Yamcs, transfer: str) -> dict[str, Any]:
    return next(one for one in _transfers(server) if one["id"] == transfer)


def _number(one: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments that identify a transfer to the satellite."""
    identifier = one["transactionId"]
    return {"source": identifier["initiatorEntity"], "number": identifier["sequenceNumber"]}


def _down(server: Yamcs, place: Path, wanted: bytes) -> dict[str, Any]:
    """Command a downlink repeatedly until the transfer begins; return whether and when the file arrived."""
    begun = time.monotonic()
    while time.monotonic() - begun < _LONGEST_S and not any(map(_is_download, _transfers(server))):
        server.command("send-file", {"entity": "another-ground-station", "name": f"log/{_RUN}/{_NAME}"})
        until(lambda: any(map(_is_download, _transfers(server))), _ASK_S)
    until(lambda: all(one["state"] == "COMPLETED" for one in _transfers(server)), _LONGEST_S)
    seconds = round(time.monotonic() - begun, 1)
    came = place / "yamcs" / DOWN_BUCKET
    until(lambda: bool(list(came.iterdir())), _ASK_S)  # Yamcs stores a completed file in the background
    sums = [hashlib.sha256(path.read_bytes()).digest() for path in came.iterdir()]
    return {"down_whole": sums == [wanted], "down_seconds": seconds}


def _up(server: Yamcs, place: Path, data: bytes) -> dict[str, Any]:
    """Make Yamcs upload a file; return whether and when it arrived."""
    begun = time.monotonic()
    (place / "yamcs" / UP_BUCKET / "release.whl").write_bytes(data)
    _send_up(server)
    until(lambda: all(one["state"] in {"COMPLETED", "FAILED"} for one in _transfers(server)), _LONGEST_S)
    arrived = place / "keys" / "files" / "received" / "release" / "release.whl"
    whole = arrived.exists() and arrived.read_bytes() == data
    until(lambda: not list((place / "keys" / "files" / "transfers").glob("in-*.json")), 120.0)
    return {"up_whole": whole, "up_seconds": round(time.monotonic() - begun, 1)}


def _send_up(server: Yamcs) -> None:
    request = {"direction": "UPLOAD", "bucket": UP_BUCKET, "objectName": "release.whl"}
    request |= {"remotePath": "release/release.whl", "source": "ground", "destination": "satellite"}
    server.ask(_TRANSFERS, {**request, "options": {"reliable": True}})


def _transfers(server: Yamcs) -> list[dict[str, Any]]:
    found = server.ask(_TRANSFERS)
    return list(found.get("transfers", []))


def _is_download(one: dict[str, Any]) -> bool:
    return bool(one["direction"] == "DOWNLOAD")


@contextmanager
def _opened(place: Path, loss: float, seed: int) -> Iterator[str]:
    """Start link, relay and gateway; yield the gateway's address."""
    udp, gateway, log = f"127.0.0.1:{free_udp_port()}", f"127.0.0.1:{free_port()}", place / "log"
    config = write_linked_config(place, udp=udp, rate=_RATE)
    with ExitStack() as stack:
        stack.enter_context(service(log, "link open", "link", config, "--log", place / "runs"))
        way = stack.enter_context(lossy_relay(udp, loss, seed))
        words = ["gateway", "--link", way, "--keys", place / "keys" / "ground", "--serve", gateway]
        stack.enter_context(service(log, "packets on", *words))
        yield gateway


@command
def main(
    folder: Annotated[Path, "for all that is written; new"],
    *,
    megabytes: Annotated[float, "of each file"] = 10.0,
    loss: Annotated[tuple[float, ...], "probabilities of a frame's loss"] = (0.0, 0.1, 0.3),
    seed: Seed = 1,
    endings: Annotated[bool, "cancel and suspend transfers instead"] = False,
) -> int:
    """Transfer files at each loss probability and print the results."""
    if problem := missing():
        sys.stdout.write(f"SKIPPED: {problem}\n")
        return 0
    sound = True
    for part in loss:
        place = folder.absolute() / f"loss-{part:g}"
        place.mkdir(parents=True)
        for facts in (ended if endings else transferred)(place, round(megabytes * 1e6), part, seed):
            say(**facts)
            sound &= facts["sound"]
    return 0 if sound else 1


if __name__ == "__main__":
    raise SystemExit(main())
