"""How late a V4L2 camera's frames are delivered, and what they cost: `python -m tests.studies.bench camera`.

The driver that flies, in real time, over the double of the kernel (`tests.hal.cameras.ioctl_camera`), whose
own cost is counted along: 1280 x 800 pixels of 8 bits at 25 frames a second, of which one each 0.25 s is
asked for. Processor time is that of the whole process, less the same loop without a camera.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

import numpy as np

from hal.buses.clock import SystemClock
from hal.drivers.camera import ServedCamera
from hal.drivers.v4l2_camera import Stamp, V4l2Camera, V4l2Settings
from tests.hal.cameras.ioctl_camera import IoctlCamera

COLUMNS, ROWS = 1280, 800
EXPOSURE_NS = 20_000_000
FRAME_NS = 40_000_000
CYCLE_NS = 25_000_000
CYCLES_A_TRIGGER = 10


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="how long (default 20)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    facts = measure(options.seconds)
    if options.json:
        sys.stdout.write(json.dumps(facts) + "\n")
        return 0
    sys.stdout.write(
        f"{facts['frames']:.0f} frames of {COLUMNS} x {ROWS} delivered, {facts['missed']:.0f} missed\n"
        f"latency after the frame's end: p50 {facts['latency_p50_ms']:.1f} ms, "
        f"p99 {facts['latency_p99_ms']:.1f} ms, most {facts['latency_max_ms']:.1f} ms\n"
        f"processor: {facts['idle_share']:.2%} of a core while none is asked for (25 frames/s given back), "
        f"{facts['frame_ms']:.2f} ms more for each frame that is delivered\n"
        f"the loop: trigger {facts['trigger_us']:.0f} us, poll {facts['poll_us']:.1f} us\n"
    )
    return 0


def measure(seconds: float) -> dict[str, float]:
    """Return latencies in ms, processor time, and the times that the loop's calls take."""
    clock = SystemClock()
    with tempfile.TemporaryDirectory() as folder:
        kernel = IoctlCamera(Path(folder), clock.now_ns)
        kernel.sizes = {"GREY": (COLUMNS, ROWS)}
        kernel.shortest_ns = FRAME_NS
        kernel.draws = False
        empty = _busy(clock, None, seconds / 4, 0)[0]
        with mock.patch("hal.drivers.v4l2_camera.ioctl", kernel):
            settings = V4l2Settings(str(kernel.path), COLUMNS, ROWS, "GREY", EXPOSURE_NS, None, Stamp.TOLD, 0)
            camera = ServedCamera(V4l2Camera(settings, clock), clock)
            idle = _busy(clock, camera, seconds / 4, 0)[0]
            asked, latencies, triggers, polls = _busy(clock, camera, seconds / 2, CYCLES_A_TRIGGER)
            camera.close()
        kernel.close()
    late = np.array(latencies) * 1e-6 - kernel.readout_ns * 1e-6
    frames_a_second = len(late) / (seconds / 2)
    return {
        "frames": float(len(late)),
        "missed": float(camera.counts.missed),
        "latency_p50_ms": float(np.percentile(late, 50)),
        "latency_p99_ms": float(np.percentile(late, 99)),
        "latency_max_ms": float(late.max()),
        "idle_share": idle - empty,
        "frame_ms": (asked - idle) / frames_a_second * 1e3,
        "trigger_us": float(np.median(triggers)) * 1e-3,
        "poll_us": float(np.median(polls)) * 1e-3,
    }


def _busy(
    clock: SystemClock, camera: ServedCamera | None, seconds: float, every: int
) -> tuple[float, list[int], list[int], list[int]]:
    """Run a 40 Hz loop; return its share of a core, and in ns latencies, times of trigger and of poll."""
    latencies: list[int] = []
    triggers: list[int] = []
    polls: list[int] = []
    begin_ns, busy = clock.now_ns(), time.process_time()
    for cycle in range(round(seconds * 1e9 / CYCLE_NS)):
        clock.sleep_until_ns(begin_ns + (cycle + 1) * CYCLE_NS)
        if camera is None:
            continue
        if every and cycle % every == 0:
            before_ns = time.perf_counter_ns()
            camera.trigger(EXPOSURE_NS)
            triggers.append(time.perf_counter_ns() - before_ns)
        before_ns = time.perf_counter_ns()
        frame = camera.poll()
        polls.append(time.perf_counter_ns() - before_ns)
        if frame is not None:
            latencies.append(frame.arrival_ns - frame.exposure_start_ns - frame.exposure_ns)
    return (time.process_time() - busy) / seconds, latencies, triggers, polls


if __name__ == "__main__":
    raise SystemExit(main())
