"""Record the new packet `thermal` and read it back.

The script needs a source tree to which `packet.diff` has been applied: git apply docs/examples/packet.diff
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from flight.link.telemetry.log import FlightLog, Recorder
from ground.documentation import markdown
from ground.telemetry import export, read_run
from sim_hal.clock import SimClock

try:
    from flight.link.telemetry.definitions import THERMAL
except ImportError:
    sys.exit("apply the change of the page first: git apply docs/examples/packet.diff")


def main() -> None:
    """Write one packet into a flight log, read it, export it, and print its documentation."""
    with tempfile.TemporaryDirectory() as name:
        folder, clock = Path(name), SimClock()
        log = FlightLog(folder, clock=clock, sync_period_ns=None)
        # In the flight software, the task that measures the values executes this line.
        Recorder(log, log).record(THERMAL, clock.now_ns(), celsius=[21.5, 19.0, 20.25, 20.5, 22.0, 18.75])
        log.close()
        run = read_run(folder)
        print("read:  ", run["thermal"]["celsius"][0].tolist())
        table, fields = export(run, folder / "csv")
        print("export:", table.read_text(encoding="utf-8").splitlines()[1])
        print("fields:", fields.read_text(encoding="utf-8").splitlines()[2])
        print("document:" + markdown().split("## thermal\n")[1])


if __name__ == "__main__":
    main()
