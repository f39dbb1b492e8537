"""A flight as a panel of the terminal, through rich."""

from __future__ import annotations

import math

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from flight.link.telemetry.definitions import SEVERITIES, STEERING
from flight.link.telemetry.definitions import STREAMS as STREAM_STATES
from flight.link.telemetry.packets import to_text
from ground.watch.plain import attitude_text
from ground.watch.view import STREAMS, View, named, printable

LISTED_EVENTS = 12
_BAR = 20
_MODE_COLOURS = {
    "safe": "bold white on red",
    "boot": "bold black on yellow",
    "detumble": "bold black on yellow",
}
_SEVERITY_COLOURS = ("dim", "yellow", "bold red")


def panel(view: View, silence: float) -> RenderableType:
    """Return the whole panel; `silence` s have passed since the log grew."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold cyan", no_wrap=True)
    facts.add_column()
    for name, value in _facts(view):
        facts.add_row(name, value)
    title = Text(" ").join([_mode(view), Text(f"{view.time:.1f} s{_planned(view)}", "bold")])
    end = f"ended: {view.ended}" if view.ended else f"no packet for {silence:.0f} s" if silence > 3.0 else ""
    body = Group(facts, Text(), _events(view))
    return Panel(body, title=title, title_align="left", subtitle=Text(end, "bold"), subtitle_align="left")


def _mode(view: View) -> Text:
    return Text(f" {view.mode or 'mode not known'} ", _MODE_COLOURS.get(view.mode, "bold black on green"))


def _planned(view: View) -> str:
    duration = view.value("run", "duration")
    return f" of {duration:.0f}" if duration is not None and math.isfinite(duration) else ""


def _facts(view: View) -> list[tuple[str, RenderableType]]:
    rows: list[tuple[str, RenderableType]] = []
    if (name := view.value("run", "config_name")) is not None:
        kind = "simulated" if view.value("run", "simulated") else "real devices"
        rows.append(("flight", Text(f"{printable(to_text(name))}, {kind}")))
    rows.append(("attitude", Text(attitude_text(view) or "no estimate")))
    rows += [(f"coil {axis}", bar) for axis, bar in zip("xyz", _bars(view), strict=False)]
    if (state := view.value("control", "state")) is not None:
        rows.append(("steering", Text(named(STEERING, state))))
    if "housekeeping" in view.newest:
        supply = [view.value("housekeeping", name) for name in ("coil_voltage", "coil_current", "coil_power")]
        volts, amperes, watts = supply
        text = f"{_figure(volts, 2)} V  {_figure(1e3 * amperes, 1)} mA  {_figure(1e3 * watts, 1)} mW"
        rows.append(("coil bus", Text(text)))
        frames, rates = (int(view.value("housekeeping", name)) for name in ("frames", "streak_rates"))
        rows.append(("camera", Text(f"{frames} frames, {rates} rates into the estimate")))
    if "health" in view.newest:
        rows.append(("streams", _streams(view)))
        cpu, slips = view.value("health", "cpu_share"), int(view.value("health", "slips"))
        text = f"slips {slips}  processor {_figure(100.0 * cpu, 0)} %  faults {view.faults}"
        rows.append(("loop", Text(text)))
    return rows


def _figure(value: float, digits: int) -> str:
    """Return a number, "-" for one that is not known."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _bars(view: View) -> list[Text]:
    """Return a bar of each coil's current within its limit."""
    written, limit = view.value("control", "current_written"), view.value("run", "current_limit")
    if written is None:
        return []
    bars = []
    for current in written:
        share = abs(current) / limit if limit and math.isfinite(current) else 0.0
        filled = min(_BAR, round(_BAR * share)) if math.isfinite(share) else 0
        text = Text(f"{1e3 * current:+8.1f} mA ")
        bars.append(
            text.append("█" * filled, "red" if filled == _BAR else "blue").append("░" * (_BAR - filled))
        )
    return bars


def _streams(view: View) -> Text:
    text = Text()
    for name in STREAMS:
        state = named(STREAM_STATES, view.value("health", name))
        if state != "not-fitted":
            text.append(f"{name} {state}  ", "green" if state == "good" else "bold red")
    return text


def _events(view: View) -> RenderableType:
    table = Table(box=None, pad_edge=False, show_header=False)
    for column in range(4):
        table.add_column(no_wrap=column < 3)
    for event in list(view.events)[-LISTED_EVENTS:]:
        colour = _SEVERITY_COLOURS[min(event.severity, len(_SEVERITY_COLOURS) - 1)]
        severity = named(SEVERITIES, event.severity)
        cells = (f"{event.time:9.3f} s", severity, event.name, event.text)
        table.add_row(*(Text(cell, colour) for cell in cells))
    return table
