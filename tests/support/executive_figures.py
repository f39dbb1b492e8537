"""Results of the benchmark `executive`, computed from the logs of a flight and samples of its processes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.link.telemetry.packets import to_text
from ground.telemetry import Run
from tests.hal.guardian.live_flight import CoilTruth
from tests.support.lateness import Grid, on_grid, robbed, slope_per_hour, stalled
from tests.support.process_watch import MIB, Look

PERIOD_NS = 25_000_000
"""Period (ns) of the control cycle (40 Hz). Mission time zero is a multiple of this period
(`flight.app.flight`)."""

SLOPE_FROM, SLOPE_SPAN = 720.0, 240.0
"""Start (s of flight) and shortest duration (s) of the interval in which the slope of the memory is fitted.

Before this time, buffers of some minutes fill up, and pages of libraries and of the sky index are loaded for
the first time.
"""

Figures = dict[str, Any]

ASKED: dict[str, float] = {
    "lost_beyond_machine": 0.0,
    "processor_control": 0.35,
    "memory_alone_max_mib": 220.0,
    "memory_slope_mib_per_hour": 1.0,
    "ready_s": 1.5,
    "first_command_s": 2.0,
}


@dataclass(frozen=True, slots=True)
class Began:
    """Times (monotonic ns) of a flight's start and READY message, and processor time (s) until READY.

    `utc_offset_ns` is UTC minus monotonic time.
    """

    exec_ns: int
    ready_ns: int
    processor_until_ready: float
    utc_offset_ns: int


@dataclass(frozen=True, slots=True)
class Watched:
    """Samples of the processes of a flight.

    Memory is in bytes, and shared memory is divided among its users.
    """

    looks: list[Look]
    shared_with_others: float


@dataclass(frozen=True, slots=True)
class Flown:
    """Results of one flight, lateness of its cycles, and lateness of the bare loop beside it."""

    figures: Figures
    flight: Grid
    machine: Grid


def evaluate(
    folder: Path, devices: Path, wakes: Path, began: Began, watched: Watched, warm_up: float
) -> Flown:
    """Return the results of the flight in `folder`. `devices` has the true states of its emulated devices."""
    truth = CoilTruth(folder, devices)
    run = truth.run
    start = run["run"][0]
    zero_ns = int(start["utc_ns"]) - began.utc_offset_ns
    first = round(zero_ns / PERIOD_NS)
    cycles = run["cycle_timing"]
    slots = cycles["cycle"].astype(np.int64)
    starts_ns = (first + slots) * PERIOD_NS + np.rint(1e9 * cycles["lateness"]).astype(np.int64)
    flight = on_grid(starts_ns, PERIOD_NS, first, int(slots[-1]) + 1)
    woke_ns, stolen_ns = np.fromfile(wakes, dtype=np.int64).reshape(-1, 2).T
    machine = on_grid(woke_ns, PERIOD_NS, first, len(flight.lateness))
    with_machine, by_host = stalled(machine), robbed(flight, woke_ns, stolen_ns)
    groups = run["rate_group"]
    control = groups[groups["name"] == b"control"][-1]
    figures: Figures = {
        "scheduling": _scheduling(run),
        "slots": len(flight.lateness),
        "slips": int(control["slips"]),
        "slips_computed": int(np.count_nonzero(flight.lost[: int(control["cycles"] + control["slips"])])),
        "closest_s": float(np.diff(starts_ns).min()) * 1e-9,
        "lost": int(np.count_nonzero(flight.lost)),
        "lost_at_s": [round(float(slot) * PERIOD_NS * 1e-9, 3) for slot in np.flatnonzero(flight.lost)],
        "lost_by_bare_loop": int(np.count_nonzero(machine.lost)),
        "lost_with_bare_loop": int(np.count_nonzero(flight.lost & with_machine)),
        "lost_while_stolen": int(np.count_nonzero(flight.lost & by_host)),
        "lost_beyond_machine": int(np.count_nonzero(flight.lost & ~with_machine)),
        "lost_unexplained": int(np.count_nonzero(flight.lost & ~with_machine & ~by_host)),
        "stolen_s": float(stolen_ns[-1] - stolen_ns[0]) * 1e-9,
        "slots_stolen_from": int(np.count_nonzero(by_host)),
        "overruns": int(control["overruns"]),
        "lateness_s": flight.figures(),
        "lateness_of_bare_loop_s": machine.figures(),
        "execution_s": {
            name: float(np.quantile(cycles["execution"], part))
            for name, part in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))
        },
        "ready_s": (began.ready_ns - began.exec_ns) * 1e-9,
        "processor_until_ready_s": began.processor_until_ready,
        "first_command_s": truth.driven_after(began.exec_ns),
        "jobs": _jobs(run, len(flight.lateness) * PERIOD_NS * 1e-9),
    }
    zero_s = zero_ns * 1e-9
    figures |= _of_processes(watched, zero_s + warm_up, zero_s + max(warm_up, SLOPE_FROM))
    figures |= waits(watched.looks, starts_ns * 1e-9, cycles["execution"])
    return Flown(figures, flight, machine)


def _scheduling(run: Run) -> str:
    """Return the real-time privileges that the flight reports."""
    events = run["event"]
    texts = [to_text(event["text"]) for event in events if event["name"].startswith(b"real-time")]
    return texts[0] if texts else "nothing asked"


def _jobs(run: Run, seconds: float) -> dict[str, Any]:
    """Return for each worker the numbers of completed and failed jobs, and its fraction of busy time."""
    timing = run["job_timing"]
    found = {}
    for name in sorted(set(timing["name"])):
        own = timing[timing["name"] == name]
        done = int(np.count_nonzero(own["outcome"] == b"done"))
        busy = float(own["execution"].sum()) / seconds
        found[to_text(name)] = {"done": done, "not_done": len(own) - done, "busy": busy}
    return found


def _of_processes(watched: Watched, warm_s: float, settled_s: float) -> Figures:
    """Return processor and memory use after the monotonic time `warm_s`, and the slopes after `settled_s`."""
    looks = [look for look in watched.looks if look.time >= warm_s]
    if len(looks) < 2:
        raise RuntimeError(f"only {len(looks)} looks at the processes after the warm-up: fly for longer")
    names = sorted({name for look in looks for name in look.memory})
    processor = {name: _share([look for look in looks if name in look.processor], name) for name in names}
    total = np.array([sum(look.memory.values()) for look in looks]) / MIB
    alone = watched.shared_with_others / MIB
    settled = [look for look in looks if look.time >= settled_s]
    times = [look.time for look in settled]
    slope = judged_slope(times, [sum(look.own.values()) / MIB for look in settled])
    of_control = judged_slope(times, [look.own["control"] / MIB for look in settled])
    return {
        "processor": processor,
        "processor_control": processor["control"],
        "looks": len(looks),
        "memory_mib": {
            name: float(np.median([look.memory.get(name, 0.0) for look in looks])) / MIB for name in names
        },
        "memory_largest_mib": {
            name: max(look.memory.get(name, 0.0) for look in looks) / MIB for name in names
        },
        "memory_median_mib": float(np.median(total)),
        "memory_max_mib": float(total.max()),
        "memory_alone_max_mib": float(total.max()) + alone,
        "memory_slope_mib_per_hour": slope[0],
        "memory_slope_interval": slope[1:],
        "control_slope_mib_per_hour": of_control[0],
        "control_slope_interval": of_control[1:],
    }


def judged_slope(seconds: list[float], levels: list[float]) -> tuple[float, float, float]:
    """Return the slope per hour and its 95 % interval, or NaN if the samples cover too short a time.

    The memory fluctuates by tenths of a MiB. Over one minute, this fluctuation alone causes a slope of tens
    of MiB/h.
    """
    if not seconds or seconds[-1] - seconds[0] < SLOPE_SPAN:
        return np.nan, np.nan, np.nan
    return slope_per_hour(seconds, levels)


def waits(looks: list[Look], starts: npt.NDArray[Any], execution: npt.NDArray[Any]) -> Figures:
    """Return the fractions of time in which the control thread waited, from the first sample to the last.

    `queued` is the fraction in which the thread was ready but had no processor. `blocked` is the fraction,
    within cycles, in which the thread was neither running nor ready, for instance because it waited for a
    worker or a disk. `blocked` is a lower limit that does not depend on the load.
    """
    first, last = looks[0], looks[-1]
    on, queued = np.subtract(last.turns["control"], first.turns["control"])
    inside = (starts >= first.time) & (starts + execution <= last.time)
    span = last.time - first.time
    blocked = max(0.0, float(execution[inside].sum()) - float(on + queued))
    return {"queued": float(queued) / span, "blocked": blocked / span}


def _share(looks: list[Look], name: str) -> float:
    """Return the fraction of a core that a process and its replacements used."""
    spent = np.diff([look.processor[name] for look in looks])
    if len(looks) < 2:  # a process that was sampled only once has ended
        return 0.0
    return float(spent[spent > 0.0].sum()) / (looks[-1].time - looks[0].time)


def misses(figures: Figures) -> list[str]:
    """Return the names of the results that exceed their limits.

    The slope exceeds its limit if its whole interval exceeds the limit. A flight that is too short for a
    slope passes this check.
    """
    found = [name for name, limit in ASKED.items() if not _slope(name) and not figures[name] <= limit]
    steep = figures["memory_slope_interval"][0] > ASKED["memory_slope_mib_per_hour"]
    return [*found, "memory_slope_mib_per_hour"] if steep else found


def _slope(name: str) -> bool:
    return name == "memory_slope_mib_per_hour"


def table(figures: Figures, name: str) -> str:
    """Return the table of limits and measured values."""
    late, bare, spent = figures["lateness_s"], figures["lateness_of_bare_loop_s"], figures["execution_s"]
    wrong = misses(figures)
    rows = [
        ("cycles lost that the bare loop did not lose", "lost_beyond_machine", "0", "{:d}"),
        ("processor, control process, % of a core", "processor_control", "35", "{:.1%}"),
        ("memory (PSS), largest, MiB", "memory_alone_max_mib", "220", "{:.1f}"),
        ("memory slope, MiB/h", "memory_slope_mib_per_hour", "1", "{:+.2f}"),
        ("exec to READY, s", "ready_s", "1.5", "{:.2f}"),
        ("exec to first coil command, s", "first_command_s", "2", "{:.2f}"),
    ]
    lines = [f"{name}: {figures['scheduling']}", f"{'':42}{'asked <=':>10}{'measured':>12}"]
    for text, key, asked, form in rows:
        known = not math.isnan(figures[key])
        measured = form.format(figures[key]).rstrip("%") if known else "unknown"
        lines.append(f"{text:42}{asked:>10}{measured:>12}{'  MISSED' if key in wrong else ''}")
    lines += [
        f"slots {figures['slots']}: lost {figures['lost']} (slips counted {figures['slips']}), of these "
        f"{figures['lost_with_bare_loop']} with the bare loop, which lost {figures['lost_by_bare_loop']}, "
        f"{figures['lost_while_stolen']} while the host took what makes a slot lost, from whichever core; "
        f"{figures['lost_unexplained']} with neither",
        f"control thread ready without a processor {figures['queued']:.1%} of the time, blocked in cycles "
        f"{figures['blocked']:.1%}; cycles {1e3 * figures['closest_s']:.1f} ms apart at least",
        f"overruns {figures['overruns']}; taken by the host {figures['stolen_s']:.1f} s, as much as makes a "
        f"slot lost in {figures['slots_stolen_from']} slots",
        f"processor time until READY {figures['processor_until_ready_s']:.2f} s",
        f"{'lateness, ms':24}" + "".join(f"{part:>10}" for part in late),
        f"{'  flight':24}" + "".join(f"{1e3 * value:10.3f}" for value in late.values()),
        f"{'  bare loop':24}" + "".join(f"{1e3 * value:10.3f}" for value in bare.values()),
        "execution of a cycle, ms: "
        + ", ".join(f"{part} {1e3 * value:.2f}" for part, value in spent.items()),
        *_of_slope(figures),
        f"memory of all: median {figures['memory_median_mib']:.1f}, largest {figures['memory_max_mib']:.1f} "
        "MiB; the row above adds what other processes share with the flight",
        f"{'process':16}{'CPU %':>8}{'PSS MiB':>10}{'largest':>9}{'jobs':>8}{'failed':>8}{'at work %':>11}",
    ]
    for process, memory in figures["memory_mib"].items():
        jobs, largest = figures["jobs"].get(process), figures["memory_largest_mib"][process]
        work = f"{jobs['done']:8}{jobs['not_done']:8}{100.0 * jobs['busy']:11.0f}" if jobs else ""
        lines.append(
            f"  {process:14}{100.0 * figures['processor'][process]:8.1f}{memory:10.1f}{largest:9.1f}{work}"
        )
    return "\n".join(lines) + "\n"


def _of_slope(figures: Figures) -> list[str]:
    """Return the lines about the slope of the memory, with its interval if the flight is long enough."""
    low, high = figures["memory_slope_interval"]
    if math.isnan(low):
        return [
            f"slope of memory: known from flights of {(SLOPE_FROM + SLOPE_SPAN) / 60.0:.0f} minutes and more"
        ]
    own = "{:+.2f} ({:+.2f} to {:+.2f})".format(
        figures["control_slope_mib_per_hour"], *figures["control_slope_interval"]
    )
    return [f"slope's 95 % interval {low:+.2f} to {high:+.2f} MiB/h; control process {own}"]
