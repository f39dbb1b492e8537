"""Modes: the state machine of the flight, and the task that turns commands and reactions into mode changes.

The transition table contains the result of every trigger in every mode. The result `TriggerAnswer.STAY` means
that the trigger has no effect in a mode. `TriggerAnswer.REFUSE` means that a command is refused.

The class `AttitudeWatch` monitors attitude knowledge and spin of a body that must acquire its attitude. The
class `PointingWatch` monitors rate and pointing error of a steered body. The class `HoldTimer` measures how
long a condition has held without interruption. A mode is entered without waiting for an estimate: a hold
takes its attitude from the first cycle that has an estimate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

from flight.link import events
from flight.link.events import ORBITAL, POINTING, STEERING, EventKind, Mode, Reaction
from flight.link.telemetry.definitions import MODE
from flight.loop import facts
from flight.loop.body import BodyTargets, FlightBody, Target
from flight.loop.facts import Facts, Services
from flight.loop.state import CRASH_WINDOW
from flight.loop.steering import Steering
from flight.schema.document import ConfigError
from flight.schema.sections import Detumble, Modes
from knightcube.errors import KnightCubeError, UsageError
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.guidance.pointing_target import SUN, PointingTarget


class Trigger(Enum):
    """A trigger of the transition table: end of the boot, command, reaction to an event, or reached goal."""

    START_SAFE = "start in safe"
    START_DETUMBLE = "start in detumble"
    START_HOLD = "start in hold"
    START_DEMO = "start in testbed-demo"
    COMMAND_SAFE = "commanded safe"
    COMMAND_DETUMBLE = "commanded detumble"
    COMMAND_HOLD = "commanded hold"
    COMMAND_SLEW = "commanded slew"
    COMMAND_DEMO = "commanded testbed-demo"
    COMMAND_SUN = "commanded sun"
    COMMAND_POINT = "commanded point"
    REACT_SAFE = "reaction safe"
    REACT_DETUMBLE = "reaction detumble"
    REACT_HOLD = "reaction hold"
    DETUMBLED = "rate is low"
    SLOWED = "rate is low, attitude unknown"
    ARRIVED = "arrived"
    KNOWN_SUN = "attitude known, turn to the Sun"
    KNOWN_POINT = "attitude known"
    LOST = "attitude lost"
    CHARGED_ACQUIRE = "battery charged, acquire"
    CHARGED_HOLD = "battery charged, hold"
    CHARGED_DEMO = "battery charged, testbed-demo"


STARTS = {
    Mode.SAFE: Trigger.START_SAFE,
    Mode.DETUMBLE: Trigger.START_DETUMBLE,
    Mode.HOLD: Trigger.START_HOLD,
    Mode.TESTBED_DEMO: Trigger.START_DEMO,
}
"""Trigger that ends the boot, for each mode that may be configured as the initial mode."""

COMMANDS = {
    Mode.SAFE: Trigger.COMMAND_SAFE,
    Mode.DETUMBLE: Trigger.COMMAND_DETUMBLE,
    Mode.HOLD: Trigger.COMMAND_HOLD,
    Mode.SLEW: Trigger.COMMAND_SLEW,
    Mode.TESTBED_DEMO: Trigger.COMMAND_DEMO,
    Mode.SUN: Trigger.COMMAND_SUN,
    Mode.POINT: Trigger.COMMAND_POINT,
}
"""State machine trigger for each mode that an operator can command (all except BOOT and ACQUIRE)."""

KNOWN = {Mode.SUN: Trigger.KNOWN_SUN, Mode.POINT: Trigger.KNOWN_POINT}
"""Trigger that ends the attitude acquisition, for each mode that may follow."""

SAFING = (Trigger.COMMAND_SAFE, Trigger.REACT_SAFE)
"""Triggers that must lead to SAFE from every mode."""


class TriggerAnswer(Enum):
    """Result of a trigger that does not change the mode."""

    STAY = "stays"
    REFUSE = "is refused"


Row = Mapping[Trigger, Mode | TriggerAnswer]
Table = Mapping[Mode, Row]

_USUAL: Row = {
    **dict.fromkeys(Trigger, TriggerAnswer.STAY),
    **{trigger: mode for mode, trigger in COMMANDS.items()},
    Trigger.REACT_SAFE: Mode.SAFE,
    Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
}
"""Default results of the triggers in every mode; the rows of the table override some of them."""

TRANSITIONS: Table = {
    Mode.BOOT: {
        **_USUAL,
        **{trigger: mode for mode, trigger in STARTS.items()},
        **dict.fromkeys(COMMANDS.values(), TriggerAnswer.REFUSE),
        Trigger.COMMAND_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: TriggerAnswer.STAY,
    },
    Mode.SAFE: {  # a command or a recharged battery ends SAFE; pointing needs acquisition
        **_USUAL,
        Trigger.COMMAND_SUN: Mode.ACQUIRE,
        Trigger.COMMAND_POINT: Mode.ACQUIRE,
        Trigger.COMMAND_SAFE: TriggerAnswer.STAY,
        Trigger.REACT_SAFE: TriggerAnswer.STAY,
        Trigger.REACT_DETUMBLE: TriggerAnswer.STAY,
        Trigger.CHARGED_ACQUIRE: Mode.ACQUIRE,
        Trigger.CHARGED_HOLD: Mode.HOLD,
        Trigger.CHARGED_DEMO: Mode.TESTBED_DEMO,
    },
    Mode.DETUMBLE: {  # a command to point takes effect once the rate is low and the attitude is known
        **_USUAL,
        Trigger.COMMAND_SUN: TriggerAnswer.STAY,
        Trigger.COMMAND_POINT: TriggerAnswer.STAY,
        Trigger.COMMAND_DETUMBLE: TriggerAnswer.STAY,
        Trigger.REACT_DETUMBLE: TriggerAnswer.STAY,
        Trigger.DETUMBLED: Mode.HOLD,
        Trigger.SLOWED: Mode.ACQUIRE,
    },
    Mode.HOLD: _USUAL,  # a repeated command holds the attitude at the time of the command
    Mode.SLEW: {**_USUAL, Trigger.REACT_HOLD: Mode.HOLD, Trigger.ARRIVED: Mode.HOLD},
    # If no plan arrives in time, the demonstration holds the attitude until the next plan arrives.
    Mode.TESTBED_DEMO: {**_USUAL, Trigger.COMMAND_DEMO: TriggerAnswer.STAY},
    Mode.ACQUIRE: {
        **_USUAL,
        **{trigger: mode for mode, trigger in KNOWN.items()},
        Trigger.COMMAND_SUN: TriggerAnswer.STAY,
        Trigger.COMMAND_POINT: TriggerAnswer.STAY,
    },
    Mode.SUN: {**_USUAL, Trigger.LOST: Mode.ACQUIRE, Trigger.COMMAND_SUN: TriggerAnswer.STAY},
    Mode.POINT: {**_USUAL, Trigger.LOST: Mode.ACQUIRE},  # a repeated command may set a new target
}


def check(table: Table) -> None:
    """Check a transition table, and raise KnightCubeError for the first error."""
    for mode in Mode:
        row = table.get(mode)
        if row is None:
            raise KnightCubeError(f"mode table: {mode.label} has no row")
        for trigger in Trigger:
            if trigger not in row:
                raise KnightCubeError(f"mode table: {mode.label} has no entry for {trigger.value!r}")
        for trigger in SAFING:
            if row[trigger] is not Mode.SAFE and not (
                mode is Mode.SAFE and row[trigger] is TriggerAnswer.STAY
            ):
                raise KnightCubeError(
                    f"mode table: trigger {trigger.value!r} does not change {mode.label} to safe"
                )
        if not any(isinstance(to, Mode) and to is not mode for to in row.values()):
            raise KnightCubeError(f"mode table: {mode.label} is a dead end")
        if mode is not Mode.BOOT and Mode.BOOT in row.values():
            raise KnightCubeError(f"mode table: {mode.label} leads back to boot, which is for the start only")
    reached, ahead = {Mode.BOOT}, [Mode.BOOT]
    while ahead:
        found = {to for to in table[ahead.pop()].values() if isinstance(to, Mode)} - reached
        reached |= found
        ahead += found
    if lost := set(Mode) - reached:
        raise KnightCubeError(f"mode table: {min(lost).label} cannot be reached from boot")


@dataclass(frozen=True, slots=True)
class ModeChange:
    """A change from one mode to another, or a repeated entry of the same mode."""

    before: Mode
    after: Mode
    trigger: Trigger


class ModeMachine:
    """State machine that determines mode changes, but does not carry them out.

    The last mode change was at `since_ns` (ns).
    """

    def __init__(self, table: Table = TRANSITIONS) -> None:
        """Begin in BOOT. Raises KnightCubeError for an invalid transition table."""
        check(table)
        self._table = table
        self.mode = Mode.BOOT
        self.since_ns = 0

    def answer(self, trigger: Trigger) -> Mode | TriggerAnswer:
        """Return the mode after `trigger`, or the reason why the mode would not change."""
        return self._table[self.mode][trigger]

    def fire(self, trigger: Trigger, now_ns: int) -> ModeChange | None:
        """Apply a trigger, and return the mode change, or None if the trigger has no effect."""
        after = self.answer(trigger)
        if isinstance(after, TriggerAnswer):
            return None
        change = ModeChange(self.mode, after, trigger)
        self.mode, self.since_ns = after, now_ns
        return change


class HoldTimer:
    """Detects that a condition has held for a required time."""

    def __init__(self, seconds: float) -> None:
        self._needed_ns = round(seconds * 1e9)
        self._since_ns: int | None = None

    def require(self, seconds: float) -> None:
        """Replace the required time (s)."""
        self._needed_ns = round(seconds * 1e9)

    def update(self, holds: bool, now_ns: int) -> bool:
        """Update the condition, and return whether it has held for the required time."""
        if not holds:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        return now_ns - self._since_ns >= self._needed_ns

    def reset(self) -> None:
        """Restart the timer."""
        self._since_ns = None


class AttitudeWatch:
    """Triggers changes between acquisition and pointing, and controls what a body does in the mode SAFE.

    The attribute `follows` is the mode after the acquisition, or None. In SAFE, the flags `detumbles` and
    `acquires_sun` state whether the body is being detumbled or turned to the Sun.
    """

    def __init__(self, settings: Modes, detumble: Detumble) -> None:
        self.follows = None if settings.acquired == Mode.ACQUIRE.label else Mode.named(settings.acquired)
        self.detumbles = self.acquires_sun = False
        self._fast, self._low = settings.tumble_rate, detumble.low_rate
        self._known = HoldTimer(settings.known_for)
        self._lost = HoldTimer(settings.lost_for)
        self._spins = HoldTimer(settings.known_for)
        self._slow = HoldTimer(detumble.low_for)

    def adopt(self, settings: Modes) -> None:
        """Replace the limits by the values of a new table of onboard parameters."""
        self._fast = settings.tumble_rate
        self._lost.require(settings.lost_for)
        for timer in (self._known, self._spins):
            timer.require(settings.known_for)

    def reset(self) -> None:
        """Restart all timers, because another mode is entered."""
        self.detumbles = self.acquires_sun = False
        for timer in (self._known, self._lost, self._spins, self._slow):
            timer.reset()

    def trigger(self, mode: Mode, known: bool, now_ns: int) -> Trigger | None:
        """Return the trigger that is due, or None; `known` states whether the attitude is known."""
        if mode is Mode.ACQUIRE and self.follows is not None and self._known.update(known, now_ns):
            return KNOWN[self.follows]
        if mode in POINTING and self._lost.update(not known, now_ns):
            return Trigger.LOST
        return None

    def watch_safe(
        self,
        rate: float,
        barred: bool,
        detumble: Callable[[int], None],
        acquire_sun: Callable[[int], None],
        now_ns: int,
    ) -> None:
        """In SAFE, detumble a body that rotates fast, and turn a slow body to the Sun.

        A latched fault (`barred`) forbids detumbling and Sun acquisition. The function `detumble` or
        `acquire_sun` is called when detumbling or Sun acquisition begins.
        """
        if self.detumbles:
            self.detumbles = not (barred or self._slow.update(rate < self._low, now_ns))
        elif self._spins.update(rate > self._fast and not barred, now_ns):
            self._slow.reset()
            self.detumbles = True
            detumble(now_ns)
        acquires_sun = not (barred or self.detumbles)
        if acquires_sun and not self.acquires_sun:
            acquire_sun(now_ns)
        self.acquires_sun = acquires_sun


class PointingWatch:
    """Monitors rate and pointing error, and updates the conditions TUMBLING and HOLD_IMPOSSIBLE."""

    def __init__(self, settings: Modes, targets: BodyTargets, facts_: Facts) -> None:
        self._settings, self._targets, self._facts = settings, targets, facts_
        self._off = HoldTimer(settings.hold_patience)

    def adopt(self, settings: Modes) -> None:
        """Replace the limits by the values of a new table of onboard parameters."""
        self._settings = settings
        self._off.require(settings.hold_patience)

    def reset(self) -> None:
        """Restart the timer of the pointing error, because another mode is entered."""
        self._off.reset()

    def watch_rate(self, rate: float, now_ns: int) -> None:
        """Update the monitored condition TUMBLING from the magnitude (rad/s) of the body rate."""
        limit = self._settings.tumble_rate
        self._facts.update(
            facts.TUMBLING, rate > limit, now_ns, lambda: f"{rate:.3f} rad/s, {limit:g} allowed"
        )

    def watch(self, estimate: Estimate, off: float | None, now_ns: int) -> float:
        """Update TUMBLING and HOLD_IMPOSSIBLE; return the pointing error `off` (rad), or 0 for None."""
        settings = self._settings
        self.watch_rate(self._targets.speed(estimate), now_ns)
        error = 0.0 if off is None else off
        impossible = self._off.update(error > settings.hold_error, now_ns)
        self._facts.update(
            facts.HOLD_IMPOSSIBLE,
            impossible,
            now_ns,
            lambda: f"{error:.2f} rad from the target for {settings.hold_patience:g} s",
        )
        return error


_HOLDING = frozenset({Mode.HOLD, Mode.SLEW})
"""Modes in which the body holds or approaches a commanded attitude."""
SAFING_REACTIONS = {
    Reaction.SAFE: Trigger.REACT_SAFE,
    Reaction.DETUMBLE: Trigger.REACT_DETUMBLE,
    Reaction.HOLD: Trigger.REACT_HOLD,
}
"""Trigger of each reaction that may change the mode."""


def modes_moved_by(reaction: Reaction) -> frozenset[Mode]:
    """Return the modes in which a reaction has an effect.

    A reaction that never changes the mode has an effect in all modes.
    """
    trigger = SAFING_REACTIONS.get(reaction)
    if trigger is None:
        return frozenset(Mode)
    return frozenset(mode for mode, row in TRANSITIONS.items() if isinstance(row[trigger], Mode))


class ModeControl:
    """Runs the mode state machine, and stores the targets that commands set.

    The text `restart` states why the process must be restarted; it is empty if no restart is needed. A hold,
    a slew, the mode SUN or a command to point sets the target `wanted`.
    """

    def __init__(
        self,
        modes: Modes,
        detumble: Detumble,
        stop: Callable[[str], None],
        body: FlightBody,
        steering: Steering,
        services: Services,
    ) -> None:
        """Connect the machine with body and steering; `stop`, given a reason, ends the flight.

        Raises KnightCubeError for an invalid table of conditions or transitions, and ConfigError if the body
        does not have the configured initial mode.
        """
        facts.check(facts.FACTS, modes_moved_by)
        self._settings, self._stop = modes, stop
        self._machine = ModeMachine()
        self._targets = body.control.targets
        self._paths = body.control.paths
        self._view = body.view
        self._steering, self._facts, self._recorder = steering, services.facts, services.recorder
        self._events, self._low_rate = services.events, detumble.low_rate
        self._modes = body.control.modes
        self._acquires = Mode.ACQUIRE in self._modes
        self._initial = Mode.named(modes.initial)
        if self._initial not in body.control.modes:
            starts = ", ".join(sorted(mode.label for mode in STARTS.keys() & body.control.modes))
            raise ConfigError("modes.initial", f"is {self._initial.label}: this body has {starts}")
        self._crashed, self._too_many_crashes = 0, False
        self._commands = self._measured_ns = 0
        self._slow = HoldTimer(detumble.low_for)
        self._arrived = HoldTimer(modes.arrived_for)
        self._pointing = PointingWatch(modes, body.control.targets, services.facts)
        self._attitude = AttitudeWatch(modes, detumble)
        self.restart = ""
        self.wanted: Target | None = None
        self._pointed: Target | None = None
        self._returns: Trigger | None = None  # trigger that ends the mode SAFE after a low battery caused it
        services.events.react_by(self.react)

    @property
    def mode(self) -> Mode:
        """The mode."""
        return self._machine.mode

    @property
    def since_ns(self) -> int:
        """The time (ns) at which the present mode was entered."""
        return self._machine.since_ns

    @property
    def flies_steps(self) -> bool:
        """Whether the configured steps are executed, or will be executed after BOOT."""
        booting = self.mode is Mode.BOOT and self._initial is Mode.TESTBED_DEMO
        return self.mode is Mode.TESTBED_DEMO or (booting and not self._too_many_crashes)

    @property
    def detumbles(self) -> bool:
        """Whether the body is being detumbled: in DETUMBLE, and in SAFE while it rotates fast."""
        return self.mode is Mode.DETUMBLE or self._attitude.detumbles

    @property
    def acquires_sun(self) -> bool:
        """Whether Sun acquisition turns the body to the Sun: in SAFE, once the body is slow."""
        return self._attitude.acquires_sun

    def target(self, mission_time_ns: int) -> Target | None:
        """Return the target in force at a mission time, or None if the mode has no target."""
        configured = self.flies_steps or (self.mode is Mode.POINT and self.wanted is None)
        return self._targets.configured(mission_time_ns) if configured else self.wanted

    def adopt(self, modes: Modes) -> None:
        """Replace the limits by the values of a new table of onboard parameters."""
        self._settings = modes
        self._arrived.require(modes.arrived_for)
        self._pointing.adopt(modes)
        self._attitude.adopt(modes)

    def begin(self, now_ns: int, unclean_recent: int) -> None:
        """Enter BOOT. `unclean_recent` is the number of recent unclean shutdowns."""
        self._machine.since_ns = self._measured_ns = now_ns
        self._crashed = unclean_recent
        self._too_many_crashes = unclean_recent >= self._settings.crash_limit
        self._record(Mode.BOOT, "begin", "", now_ns)

    def step(
        self,
        estimate: Estimate | None,
        rate: float | None,
        overdue: float | None,
        coils_answer: bool,
        now_ns: int,
        accurate: bool = True,
    ) -> Mode:
        """Check the conditions of the present mode, and return the mode for this cycle.

        Args:
            estimate: state estimate of this cycle, or None while the attitude is not known.
            rate: magnitude (rad/s) of the newest body rate measured in this cycle, or None if none was.
            overdue: angle (rad) between the body and the presently required attitude, or None if no attitude
                is required.
            coils_answer: whether the PWM chip acknowledges commands.
            now_ns: time (ns) of the cycle.
            accurate: whether the estimate is accurate enough for driving the coils.
        """
        # While its attitude is acquired, a body needs only a known rate, except for steering.
        measured = estimate is not None and accurate
        if self._acquires:
            measured = rate is not None and (measured or estimate is None or self.mode not in STEERING)
        self._measured_ns = now_ns if measured else self._measured_ns
        if self.mode is Mode.BOOT:
            self._boot(measured and coils_answer, now_ns)
        blind = (now_ns - self._measured_ns) * 1e-9
        missing = "estimate" if estimate is None else "estimate accurate enough for control"
        missing = "body rate" if self._acquires and rate is None else missing
        late = blind > self._settings.blind_limit
        self._facts.update(facts.BLIND, late, now_ns, lambda: f"no {missing} for {blind:.0f} s")
        if self.mode is Mode.DETUMBLE and rate is not None:
            self._brake(estimate, rate, now_ns)
        elif self.mode in ORBITAL and rate is not None:
            self._pointing.watch_rate(rate, now_ns)
        elif self._acquires and self.mode is Mode.SAFE and rate is not None:
            barred, law = bool(_barred(self._facts)), self._steering
            self._attitude.watch_safe(rate, barred, law.begin_detumbling, law.begin_sun_acquisition, now_ns)
        if (trigger := self._attitude.trigger(self.mode, estimate is not None, now_ns)) is not None:
            self._fire(trigger, "", now_ns)
        if estimate is not None and self.mode in _HOLDING:
            self._keep(estimate, now_ns)
        elif estimate is not None and self.mode is Mode.TESTBED_DEMO:
            self._pointing.watch(estimate, overdue, now_ns)
        return self.mode

    def command(self, mode: Mode, now_ns: int, wanted: float | PointingTarget | None = None) -> str:
        """Execute a mode command with the target `wanted`, and return why it is refused, or an empty text.

        After a command POINT without a target, the body follows the configured targets again.
        """
        trigger = COMMANDS.get(mode)
        if trigger is None or mode not in self._modes:
            allowed = ", ".join(one.label for one in COMMANDS if one in self._modes and one is not Mode.SLEW)
            return f"{mode.label} cannot be commanded" + (f" of this body: use {allowed}" if trigger else "")
        answer = self._machine.answer(trigger)
        if answer is TriggerAnswer.REFUSE:
            return f"not while in {self.mode.label}"
        if answer is TriggerAnswer.STAY and mode not in POINTING:
            self._returns = None if mode is Mode.SAFE else self._returns
            return ""
        if self.mode is Mode.SAFE and (barred := _barred(self._facts)):
            return barred
        target = None
        if mode is Mode.SLEW or wanted is not None:
            try:
                target = self._targets.commanded(math.nan if wanted is None else wanted, self._commands + 1)
            except UsageError as error:
                return str(error)
            self._commands += 1
        if mode in POINTING:
            self._attitude.follows = mode
        if mode is Mode.POINT:
            self._pointed = target
        elif target is not None:
            self.wanted = target
        self._fire(trigger, "" if target is None else f"to {target.law.text}", now_ns)
        return ""

    def react(self, kind: EventKind, time_ns: int, text: str) -> None:
        """Carry out the reaction to an event. The event log calls this method."""
        reaction = kind.reaction
        if reaction is Reaction.COILS_OFF:
            self._steering.zero()
        elif reaction is Reaction.ISOLATE:
            self._steering.isolate()
        elif reaction is Reaction.RESTART:
            self.restart = f"{kind.name}: {text}"
            self._stop(f"restart requested: {self.restart}")
        elif reaction is Reaction.RETURN:
            if self._returns is not None and not _barred(self._facts):
                self._fire(self._returns, kind.name, time_ns)
        elif reaction in SAFING_REACTIONS:
            before = self.mode
            self._fire(SAFING_REACTIONS[reaction], kind.name, time_ns)
            if kind is events.BATTERY_CRITICAL and self.mode is not before:
                self._returns = self._return_to(before)

    def _return_to(self, before: Mode) -> Trigger | None:
        """Return the trigger that continues the flight after a low battery has ended the mode `before`.

        The result is None if the flight would have stayed in SAFE after BOOT.
        """
        if before is Mode.BOOT and self._initial is Mode.SAFE:
            return None
        if self._acquires:
            return Trigger.CHARGED_ACQUIRE
        demo = before is Mode.TESTBED_DEMO or (before is Mode.BOOT and self._initial is Mode.TESTBED_DEMO)
        return Trigger.CHARGED_DEMO if demo else Trigger.CHARGED_HOLD

    def _boot(self, good: bool, now_ns: int) -> None:
        waited = (now_ns - self._machine.since_ns) * 1e-9
        if self._too_many_crashes:
            text = f"{self._crashed} unclean shutdowns within {CRASH_WINDOW:g} s of operation"
            self._events.report(events.CRASHED_OFTEN, now_ns, text)
            self._fire(Trigger.START_SAFE, text, now_ns)
        elif good:
            self._fire(STARTS[self._initial], "", now_ns)
        else:
            late = waited > self._settings.boot_patience
            self._facts.update(facts.BOOT_WAITS, late, now_ns, f"for {waited:.1f} s: coils at zero")

    def _brake(self, estimate: Estimate | None, rate: float, now_ns: int) -> None:
        """End detumbling when the rate is low enough."""
        # If a hold follows, wait for an attitude at which the coils can produce torque.
        holds = Mode.HOLD in self._modes
        within = not holds or (estimate is not None and self._targets.can_hold(estimate))
        if self._slow.update(rate < self._low_rate and within, now_ns):
            over = Trigger.DETUMBLED if holds else Trigger.SLOWED
            self._fire(over, f"below {self._low_rate:g} rad/s", now_ns)

    def _keep(self, estimate: Estimate, now_ns: int) -> None:
        """Check the progress of a hold or of a slew."""
        settings = self._settings
        if self.wanted is None:
            self.wanted = self._targets.hold_here(estimate, now_ns)
        error = self._pointing.watch(estimate, self._targets.error(estimate, self.wanted), now_ns)
        slewing = (now_ns - self._machine.since_ns) * 1e-9
        near = error < settings.arrived_angle and self._targets.speed(estimate) < settings.arrived_rate
        if self.mode is Mode.SLEW and self._arrived.update(near, now_ns):
            self._fire(Trigger.ARRIVED, f"{error:.4f} rad from the target", now_ns)
        text = f"{error:.3f} rad from the target after {slewing:.0f} s"
        self._facts.update(facts.SLEW_LATE, slewing > settings.slew_limit, now_ns, text)

    def _fire(self, trigger: Trigger, reason: str, now_ns: int) -> None:
        change = self._machine.fire(trigger, now_ns)
        if change is not None:
            self._enter(change, reason, now_ns)

    def _enter(self, change: ModeChange, reason: str, now_ns: int) -> None:
        """Enter a mode: reset timers, discard an old path, and zero the coils unless the mode steers."""
        self._facts.enter(change.after)
        self._returns = None
        for timer in (self._slow, self._arrived, self._pointing, self._attitude):
            timer.reset()
        if change.before not in STEERING | {Mode.BOOT}:
            self._paths.release()  # an old path would not start at the present attitude
        if change.after is Mode.DETUMBLE:
            self._steering.begin_detumbling(now_ns)
        if change.after is Mode.SUN:
            self.wanted = self._targets.commanded(SUN, 0)
        elif change.after is Mode.POINT:
            self.wanted = self._pointed
        elif change.after is not Mode.SLEW and change.trigger is not Trigger.ARRIVED:
            self.wanted = None
        if change.after not in STEERING:
            self._steering.zero()
        self._record(change.before, change.trigger.value, reason, now_ns)
        if change.before is not Mode.BOOT:
            because = f": {reason}" if reason else ""
            text = f"{change.before.label} -> {change.after.label}, {change.trigger.value}{because}"
            self._events.report(events.MODE, now_ns, text)

    def _record(self, before: Mode, trigger: str, reason: str, now_ns: int) -> None:
        self._recorder.record(
            MODE,
            now_ns,
            before=int(before),
            mode=int(self.mode),
            trigger=trigger,
            reason=reason,
            **self._view.mode_fields(self.wanted),
        )


def _barred(known: Facts) -> str:
    """Return a text about the latched conditions that keep the body in SAFE; empty if there are none."""
    held = [
        fact.begins.name for fact in known.held() if fact.latching and fact.begins.reaction is Reaction.SAFE
    ]
    return f"refused until cleared: {', '.join(held)}" if held else ""
