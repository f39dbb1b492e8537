"""State of a flight as a terminal panel, for which the package rich is needed."""

from __future__ import annotations

import math

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from flight.link.telemetry.definitions import SEVERITIES, STEERING
from flight.link.telemetry.definitions import STREAMS as STREAM_STATES
from flight.link.telemetry.packets import to_text
from ground.watch import STREAMS, FlightState, attitude_text, named, printable

LISTED_EVENTS = 12
_BAR = 20  # width (characters) of the bar that shows a coil current
_MODE_COLOURS = {
    "safe": "bold white on red",
    "boot": "bold black on yellow",
    "detumble": "bold black on yellow",
}
_STREAM_COLOURS = {"good": "green", "no-reading-yet": "dim"}
"""Colours of the stream states that are not alarms."""
_SEVERITY_COLOURS = ("dim", "yellow", "bold red")


def panel(state: FlightState, silence: float) -> RenderableType:
    """Return the panel of a flight whose log has not grown for `silence` s."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold cyan", no_wrap=True)
    facts.add_column()
    for name, value in _facts(state):
        facts.add_row(name, value)
    duration = state.value("run", "duration")
    planned = f" of {duration:.0f}" if duration is not None and math.isfinite(duration) else ""
    mode = state.mode or "mode not known"
    colour = _MODE_COLOURS.get(state.mode, "bold black on green")
    title = Text(" ").join([Text(f" {mode} ", colour), Text(f"{state.time:.1f} s{planned}", "bold")])
    silent = f"no packet for {silence:.0f} s" if silence > 3.0 else ""
    end = Text(f"ended: {state.ended}" if state.ended else silent, "bold")
    events = Table(box=None, pad_edge=False, show_header=False)
    for column in range(4):
        events.add_column(no_wrap=column < 3)
    for event in list(state.events)[-LISTED_EVENTS:]:
        colour = _SEVERITY_COLOURS[min(event.severity, len(_SEVERITY_COLOURS) - 1)]
        severity = named(SEVERITIES, event.severity)
        cells = (f"{event.time:9.3f} s", severity, event.name, event.text)
        events.add_row(*(Text(cell, colour) for cell in cells))
    body = Group(facts, Text(), events)
    return Panel(body, title=title, title_align="left", subtitle=end, subtitle_align="left")


def _facts(state: FlightState) -> list[tuple[str, RenderableType]]:
    rows: list[tuple[str, RenderableType]] = []
    if (name := state.value("run", "config_name")) is not None:
        kind = "simulated" if state.value("run", "simulated") else "real devices"
        rows.append(("flight", Text(f"{printable(to_text(name))}, {kind}")))
    rows.append(("attitude", Text(attitude_text(state) or "no estimate")))
    rows += [(f"coil {axis}", bar) for axis, bar in zip("xyz", _bars(state), strict=False)]
    if (steering := state.value("control", "state")) is not None:
        rows.append(("steering", Text(named(STEERING, steering))))
    if "housekeeping" in state.newest:
        volts, amperes, watts, frames, rates = (
            state.value("housekeeping", name)
            for name in ("coil_voltage", "coil_current", "coil_power", "frames", "streak_rates")
        )
        text = f"{_figure(volts, 2)} V  {_figure(1e3 * amperes, 1)} mA  {_figure(1e3 * watts, 1)} mW"
        rows.append(("coil bus", Text(text)))
        rows.append(("camera", Text(f"{int(frames)} frames, {int(rates)} rates used by the estimator")))
    if "health" in state.newest:
        streams = Text()
        for name in STREAMS:
            stream = named(STREAM_STATES, state.value("health", name))
            if stream != "not-fitted":
                streams.append(f"{name} {stream}  ", _STREAM_COLOURS.get(stream, "bold red"))
        rows.append(("streams", streams))
        cpu, slips = state.value("health", "cpu_share"), int(state.value("health", "slips"))
        text = f"slips {slips}  processor {_figure(100.0 * cpu, 0)} %  faults {state.faults}"
        rows.append(("loop", Text(text)))
    return rows


def _figure(value: float, digits: int) -> str:
    """Return a number as text, or "-" if it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _bars(state: FlightState) -> list[Text]:
    """Return a bar for each coil that shows the current relative to its limit."""
    written, limit = state.value("control", "current_written"), state.value("run", "current_limit")
    bars = []
    for current in () if written is None else written:
        share = abs(current) / limit if limit and math.isfinite(current) else 0.0
        filled = min(_BAR, round(_BAR * share)) if math.isfinite(share) else 0
        bar = Text(f"{1e3 * current:+8.1f} mA ")
        bar.append("█" * filled, "red" if filled == _BAR else "blue")
        bars.append(bar.append("░" * (_BAR - filled)))
    return bars
