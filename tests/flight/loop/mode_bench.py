"""Test bench of the mode control and a body with one angle. Tests set each condition."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

from flight.link.events import Mode
from flight.loop.facts import EventLog, Facts
from flight.loop.modes import ModeControl
from flight.schema.sections import Detumble, Modes
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import UsageError

TESTBED = frozenset({Mode.BOOT, Mode.SAFE, Mode.DETUMBLE, Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO})
SATELLITE = frozenset({Mode.BOOT, Mode.SAFE, Mode.DETUMBLE, Mode.ACQUIRE, Mode.SUN, Mode.POINT})


def target(name: str) -> Any:
    """Return a target that has only a name."""
    return SimpleNamespace(index=0, law=SimpleNamespace(text=name))


class OneAngle:
    """Test double for the targets of a body with one angle, which reports values that tests set."""

    def __init__(self) -> None:
        self.rate, self.off, self.holdable = 0.0, 0.0, True

    def configured(self, mission_time_ns: int) -> Any:
        """Return the configured target."""
        return target("configured")

    def commanded(self, wanted: object, number: int) -> Any:
        """Return the target of a command; the target "far" is refused."""
        if wanted == "far":
            raise UsageError("too far")
        return target(f"{wanted} as number {number}")

    def hold_here(self, estimate: object, now_ns: int) -> Any:
        """Return the target that keeps the attitude at the given time."""
        return target(f"here at {now_ns}")

    def can_hold(self, estimate: object) -> bool:
        """Return whether the coils can hold the attitude."""
        return self.holdable

    def speed(self, estimate: object) -> float:
        """Return the rate."""
        return self.rate

    def error(self, estimate: object, wanted: object) -> float:
        """Return the angle to the target."""
        return self.off


@dataclass
class ModeBench:
    """The mode control with a record of its requests.

    `step` advances the clock by a second and runs a cycle.
    """

    modes: frozenset[Mode] = TESTBED
    settings: Modes = field(default_factory=Modes)
    unclean: int = 0

    def __post_init__(self) -> None:
        self.events: list[str] = []
        self.texts: list[str] = []
        self.asked: list[str] = []
        self.records: list[dict[str, Any]] = []
        self.now_ns = 0
        self.targets = OneAngle()
        log = EventLog(self._event, throttle_ns=0)
        self.facts = Facts(log)
        control = SimpleNamespace(
            targets=self.targets, paths=SimpleNamespace(release=self._note("release")), modes=self.modes
        )
        view = SimpleNamespace(mode_fields=lambda wanted: {"target_q2": 0.0})
        steering = SimpleNamespace(
            zero=self._note("zero"),
            isolate=self._note("isolate"),
            begin_detumbling=self._note("detumble"),
            begin_sun_acquisition=self._note("sun"),
        )
        recorder = SimpleNamespace(record=lambda packet, now_ns, **values: self.records.append(values))
        services = SimpleNamespace(facts=self.facts, events=log, recorder=recorder)
        self.control = ModeControl(
            self.settings,
            Detumble(low_rate=0.01, low_for=2.0),
            self._note("stop"),
            cast(Any, SimpleNamespace(control=control, view=view)),
            cast(Any, steering),
            cast(Any, services),
        )
        self.control.begin(0, self.unclean)

    def _event(self, kind: Any, time_ns: int, held_back: int, text: str) -> None:
        self.events.append(kind.name)
        self.texts.append(text)

    def _note(self, what: str) -> Any:
        return lambda *_: self.asked.append(what)

    def mode(self) -> Mode:
        """Return the present mode."""
        return self.control.mode

    def step(
        self,
        *,
        known: bool = True,
        rate: float | None = 0.0,
        overdue: float | None = None,
        answers: bool = True,
        accurate: bool = True,
        seconds: float = 1.0,
    ) -> Mode:
        """Run one cycle in which the rate and the error of the estimate are those of `targets`."""
        self.now_ns += round(seconds * SECOND_NS)
        estimate = cast(Any, object()) if known else None
        return self.control.step(estimate, rate, overdue, answers, self.now_ns, accurate)
