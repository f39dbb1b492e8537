"""Flight on a board of the 800 MHz class.

The flight runs in real time on emulated devices, with image processing and planner. It is limited to a
fraction of one core and 512 MB of memory. The share makes this core as fast as an ARM Cortex-A53 at 800 MHz.
It follows from benchmarks (heap sort and Linpack's elimination) that are measured here and compared with the
published figures of that processor (`tests.support.processor_share`). The inertial unit sends 200 readings a
second (`--imu-rate`). The limit does not apply to the emulated devices. `--camera-period` and
`--replan-period` can request more work than the board can do, so that the flight sheds work. The benchmark
needs root, and a cgroup hierarchy with the controllers `cpu` and `memory`. `user_mode_linux.sh` runs the
bench with cgroup v2 on a machine with cgroup v1.
"""

from __future__ import annotations

import os
import sys
import threading
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import yaml

from ground.telemetry import Run, read_run
from knightcube.errors import UsageError
from tests.hal.guardian.live_flight import LiveFlight
from tests.studies.bench import executive
from tests.studies.command import Json, command, say, scratch
from tests.support import process_watch
from tests.support.executive_figures import Figures
from tests.support.process_watch import MIB
from tests.support.processor_share import CORTEX_A53, Limits, limited, measure

MEMORY = 512 * 1024 * 1024
"""Memory of the board (bytes)."""
IMU_BAUD = 230_400
SLOW_AFTER_S, FRAME_AGE_S, TIMEOUT_S = 5.0, 60.0, 60.0
"""Times (s) that a slow board needs: age of a frame, time between frames, and timeout of a job."""
_WORKERS = ("planner", "vision", "wide")


@dataclass(frozen=True)
class Wish:
    """Options of the flight.

    They are the duration (s), whether the flight is in orbit, periods (s) of frames and plans, share of a
    core or None, and inertial readings per second.
    """

    duration: float
    orbit: bool
    camera_period: float
    replan_period: float
    share: float | None
    imu_rate: int


@command
def main(
    *,
    minutes: Annotated[float, "of the flight"] = 3.0,
    orbit: Annotated[bool, "fly the satellite, not the step demonstration"] = False,
    camera_period: Annotated[float, "s"] = 5.0,
    replan_period: Annotated[float | None, "s (default 5, in orbit 10, the shortest permitted)"] = None,
    share: Annotated[float | None, "of a core (default: by the yardstick)"] = None,
    no_limit: Annotated[bool, "fly with the whole machine, to compare"] = False,
    imu_rate: Annotated[int, "Hz", (40, 50, 100, 200)] = 200,
    json: Json = False,
) -> int:
    """Measure the speed of the core, run the flight, and print the completed and the shed work."""
    if not 0.5 <= minutes < 1e4:
        raise UsageError(f"--minutes {minutes:g}: a flight takes half a minute at least")
    if share is not None and no_limit:
        raise UsageError("--share: not allowed with --no-limit")
    printed = ""
    if share is None and not no_limit:
        here = measure()
        share = here.share(CORTEX_A53)
        printed = (
            f"yardstick: {here.sorts:.0f} sorts/s, {here.mflops:.0f} MFLOPS here; {CORTEX_A53.sorts:.0f}, "
            f"{CORTEX_A53.mflops:.0f} of {CORTEX_A53.name} ({CORTEX_A53.source})\n"
        )
    if share is not None and not 0.001 <= share <= 1.0:
        raise UsageError(f"--share {share:g}: must lie between 0.001 and 1")
    replan = replan_period or (executive.SHORTEST_REPLAN if orbit else 5.0)
    wish = Wish(60.0 * minutes, orbit, camera_period, replan, share, imu_rate)
    with executive.compiled(), scratch() as folder:
        figures = fly(folder, wish)
    if json:
        say(wish=asdict(wish), yardstick=printed, **figures)
    else:
        sys.stdout.write(printed + table(wish, figures))
    return int(figures["lost_beyond_machine"] > 0 or figures["memory_refusals"] > 0)


def configuration(wish: Wish, load: executive.Load) -> str:
    """Return the configuration, with the times that a slow board needs."""
    tree = yaml.safe_load(executive.full_load(load))
    if wish.orbit:
        tree["pointing"]["replan_period"] = wish.replan_period
    else:
        tree["guidance"]["strategy"] = "receding"
    tree["inertial_unit"] |= {"rate_hz": wish.imu_rate, "baud_rate": IMU_BAUD}
    tree["camera"] |= {"vision_slow_after": SLOW_AFTER_S, "max_age": FRAME_AGE_S}
    tree["executive"] = {"planner_timeout": TIMEOUT_S, "vision_timeout": TIMEOUT_S}
    return yaml.safe_dump(tree, sort_keys=False)


def fly(folder: Path, wish: Wish) -> Figures:
    """Run the flight once in `folder`, and return the results.

    Raises OSError if the system refuses the limit.
    """
    periods = wish.camera_period, wish.replan_period, min(30.0, 0.2 * wish.duration)
    load = executive.Load(wish.duration, *periods, look_period=2.0, orbit=wish.orbit)
    with nullcontext() if wish.share is None else limited(wish.share, MEMORY) as limits:

        def start(stack: ExitStack, *words: Any) -> LiveFlight:
            return LiveFlight(*words) if limits is None else _limited(limits, stack, *words)

        flown = executive.watched_flight(folder, configuration(wish, load), load, 0, start)
        used = None if limits is None else limits.used()
    found = flown.figures | _shed(read_run(folder / "run"), wish.duration)
    half = 0.5 * wish.duration
    found |= {"lost_in_second_half": sum(time_s > half for time_s in found["lost_at_s"])}
    found |= {"memory_refusals": 0 if used is None else used.refusals}
    if used is not None:
        found |= {"throttled": used.throttled / max(used.periods, 1), "memory_group_mib": used.memory / MIB}
    return found


def _limited(limits: Limits, stack: ExitStack, *words: Any) -> LiveFlight:
    """Start a flight within the limits; processes that already run are not limited."""
    for process in process_watch.below(os.getpid()):
        limits.release(process)
    flight, stop = LiveFlight(*words, before=limits.line()), threading.Event()
    demoting = threading.Thread(target=_demote, args=(flight, limits, stop), daemon=True)
    demoting.start()
    stack.callback(demoting.join)
    stack.callback(stop.set)
    return flight


def _demote(flight: LiveFlight, limits: Limits, stop: threading.Event) -> None:
    """Give each worker, once it exists, a lower priority than the control process."""
    done: set[int] = set()
    while not stop.wait(0.1):
        for role, process in executive.members(flight).items():
            if role in _WORKERS and process not in done:
                limits.demote(process)
                done.add(process)


def _shed(run: Run, seconds: float) -> Figures:
    """Return the completed and the shed work that the flight reports."""
    house, load = run["housekeeping"], run["workload"]
    last = house[-1]
    span = (int(last["time_ns"]) - int(house[0]["time_ns"])) * 1e-9
    events = [bytes(event["name"]).rstrip(b"\0").decode() for event in run["event"]]
    counters = ("frames_shed", "plans_shed", "frames_late", "plans_late")
    return {
        "imu_hz": (int(last["imu_packets"]) - int(house[0]["imu_packets"])) / span,
        "frames": int(last["frames"]),
        "streak_rates": int(last["streak_rates"]),
        "plans_accepted": int(last["plans_accepted"]),
        "plans_refused": int(last["plans_refused"]),
        "level": int(load["level"].max()) if len(load) else 0,
        "level_at_end": int(load["level"][-1]) if len(load) else 0,
        **{name: int(load[name][-1]) if len(load) else 0 for name in counters},
        "seconds": seconds,
        "events": {name: events.count(name) for name in sorted(set(events))},
    }


def table(wish: Wish, figures: Figures) -> str:
    """Return the results as text."""
    late, spent = figures["lateness_s"], figures["execution_s"]
    group = f"; the group's {figures['memory_group_mib']:.0f} MiB" if "throttled" in figures else ""
    throttled = f", throttled in {figures['throttled']:.0%} of the periods" if "throttled" in figures else ""
    limit = "no limit" if wish.share is None else f"{wish.share:.1%} of a core, 512 MB{throttled}"

    def listed(*names: str) -> str:
        return "; ".join(str(figures[name]) for name in names)

    rows: list[tuple[str, Any]] = [
        ("craft; limit", f"{'satellite' if wish.orbit else 'testbed'}; {limit}"),
        (
            "control cycles; lost; lost in the second half; by the bare loop",
            listed("slots", "lost", "lost_in_second_half", "lost_by_bare_loop"),
        ),
        ("lateness, ms", ", ".join(f"{name} {1e3 * value:.2f}" for name, value in late.items())),
        ("duration of a cycle, ms", ", ".join(f"{name} {1e3 * value:.2f}" for name, value in spent.items())),
        ("processor of control, % of a core", f"{100.0 * figures['processor_control']:.1f}"),
        ("memory (PSS), largest, MiB", f"{figures['memory_alone_max_mib']:.0f}{group}"),
        (
            "exec to READY; to the first current, s",
            f"{figures['ready_s']:.1f}; {figures['first_command_s']:.1f}",
        ),
        ("readings of the inertial unit, Hz", f"{figures['imu_hz']:.1f}"),
        ("frames taken; late; shed", listed("frames", "frames_late", "frames_shed")),
        (
            "plans flown; refused; late; shed",
            listed("plans_accepted", "plans_refused", "plans_late", "plans_shed"),
        ),
        ("level of shedding: highest; at the end", listed("level", "level_at_end")),
        (
            "jobs",
            "; ".join(
                f"{name} {jobs['done']} done, {jobs['not_done']} not, at work {jobs['busy']:.0%}"
                for name, jobs in figures["jobs"].items()
            ),
        ),
        ("events", ", ".join(f"{name} {count}" for name, count in figures["events"].items())),
    ]
    return "".join(f"{name}: {value}\n" for name, value in rows)
