"""Send the new command `note` to a flight.

The script needs a source tree to which `command.diff` has been applied: git apply docs/examples/command.diff
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from flight.link.telemetry.definitions import COMMAND
from flight.link.telemetry.packets import to_text
from ground.link.commanding import exchange
from ground.telemetry import decode, read_run

try:
    from flight.link.commands import CommandPacker, Note
except ImportError:
    sys.exit("apply the change of the page first: git apply docs/examples/command.diff")

CONFIG = Path("config/step_demo.yaml")


def main() -> None:
    """Run the demonstration flight with a command socket, send a remark to it, and read the flight log."""
    with tempfile.TemporaryDirectory() as name:
        folder, socket = Path(name), Path(name) / "commands"
        text = CONFIG.read_text(encoding="utf-8")
        before, _, after = text.partition("camera: ")
        text = before + "camera: none\n\nestimation:" + after.partition("\nestimation:")[2]
        config = folder / "listening.yaml"
        config.write_text(text + f"\ncommands: {{socket: {socket}}}\n", encoding="utf-8")
        words = ["run", str(config), "--out", str(folder / "run"), "--duration", "30"]
        flight = subprocess.Popen([sys.executable, "-m", "flight", *words], stdout=subprocess.DEVNULL)
        while not socket.exists() and flight.poll() is None:
            time.sleep(0.01)
        answer = exchange(str(socket), CommandPacker().pack(Note("lamp on"), utc_ns=1), timeout=10.0)
        (row,) = decode(answer)[COMMAND.name]
        print("answer:", "executed" if row["obeyed"] else "refused", "-", to_text(row["text"]))
        flight.wait()
        events = read_run(folder / "run")["event"]
        for event in events[events["name"] == b"commanded"]:
            print(
                "log:   ", f"{event['time_ns'] * 1e-9:.1f} s,", to_text(event["name"]), to_text(event["text"])
            )


if __name__ == "__main__":
    main()
