"""What command lines are pointed at: small runs, configurations, pictures, sound and unsound; and a flight.

Everything is as small as still leads into the commands: a picture of 128 pixels in which stars are
identified, a flight of seconds in which a body is found.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import threading
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from flight.app import cli
from flight.link.commands import LONGEST
from flight.link.modes import Mode
from flight.link.telemetry.definitions import COMMAND
from flight.link.telemetry.packets import Packer
from sim_hal.star_camera import StarCameraModel
from tests.ground.report.synthetic import Recipe, make_run
from tests.knightcube.vision.startracker.frames import sky_frame
from tests.support.fits_files import fits_file
from tests.support.scenes import slew

ROOT = Path(__file__).resolve().parents[2]
FIELD_DEG = 12.0
_PIXELS = 128
_IDENTIFY_S = "12"


def furnish(folder: Path) -> None:
    """Fill an empty folder."""
    text = (ROOT / "config" / "step_demo.yaml").read_text(encoding="utf-8")
    (folder / "whole.yaml").write_text(text, encoding="utf-8")
    tree = yaml.safe_load(text)
    _write(folder / "good.yaml", {**tree, "camera": "none", "duration": 30.0, "steps": tree["steps"][:1]})
    small = {
        **tree["camera"],
        "columns": _PIXELS,
        "rows": _PIXELS,
        "field_of_view_deg": FIELD_DEG,
        "exposure": 0.2,
    }
    _write(folder / "camera.yaml", {**tree, "camera": small})
    shutil.copy(ROOT / "config" / "testbed.yaml", folder / "real.yaml")
    (folder / "bad.yaml").write_text("name: [\n")
    (folder / "notes.txt").write_bytes(bytes(range(256)))
    (folder / "empty").mkdir()
    make_run(folder / "run", Recipe(duration=5.0, planned=5.0, hold=2.0, rate_hz=10.0))
    shutil.copytree(folder / "run", folder / "runs" / "run-000001")
    _take_pictures(folder)
    words = ["identify", str(folder / "good.yaml"), "--run", str(folder / "flown"), "--seed", "5"]
    if cli.main([*words, "--duration", _IDENTIFY_S, "--out", str(folder / "plant.yaml")]) != 0:
        raise RuntimeError("the flight for `identify` did not succeed")


def _write(path: Path, tree: Any) -> None:
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")


def _take_pictures(folder: Path) -> None:
    model = StarCameraModel(columns=_PIXELS, rows=_PIXELS, field_of_view=float(np.radians(FIELD_DEG)))
    sky = sky_frame(np.random.default_rng(31), 0.0, 0.5, model).pixels
    Image.fromarray(sky).save(folder / "sky.png")
    Image.fromarray(sky).save(folder / "sky.tiff")
    (folder / "sky.raw").write_bytes(sky.tobytes())
    signed = (sky.astype(np.int32) - 32768).astype(">i2")
    (folder / "sky.fits").write_bytes(fits_file(signed, 16, BZERO=32768))
    streaks = slew(np.random.default_rng(20), float(np.radians(80.0)), 0.12, 0.2, model=model).pixels
    Image.fromarray(streaks).save(folder / "streaks.png")
    rows, columns = np.mgrid[:96, :96]
    limb = np.where(np.hypot(columns - 48.0, rows - 160.0) < 110.0, 180, 8).astype(np.uint8)
    Image.fromarray(limb).save(folder / "limb.png")
    Image.fromarray(np.stack([limb] * 3, axis=2)).save(folder / "limb.jpg")
    Image.new("L", (64, 48), 10).save(folder / "flat.png")
    (folder / "short.png").write_bytes((folder / "flat.png").read_bytes()[:60])


def answer(obeyed: bool) -> bytes:
    """Return a flight's answer to a command."""
    fields = dict.fromkeys((field.name for field in COMMAND.fields), 0)
    texts = {field.name: "as commanded" for field in COMMAND.fields if field.kind.startswith("S")}
    return Packer().pack(COMMAND, 5, {**fields, **texts, "obeyed": int(obeyed), "mode": int(Mode.HOLD)})


class Listener:
    """A flight that answers every command with `reply`, whatever that is."""

    def __init__(self, path: Path) -> None:
        self._reply = [answer(True)]
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._line.bind(str(path))
        threading.Thread(target=_listen, args=(self._line, self._reply), daemon=True).start()
        weakref.finalize(self, self._line.shutdown, socket.SHUT_RDWR)

    def will_say(self, reply: bytes) -> None:
        """Answer so from now on."""
        self._reply[0] = reply


def _listen(line: socket.socket, reply: list[bytes]) -> None:
    """Answer until the line is shut."""
    while True:
        _, sender = line.recvfrom(LONGEST)
        if not sender:
            line.close()
            return
        with contextlib.suppress(OSError):  # who asked has gone again
            line.sendto(reply[0], sender)
