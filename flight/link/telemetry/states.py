"""The states of fields: the numbers that stand in them, each with its name, and which of them are poor."""

from __future__ import annotations

from flight.link.events import Severity
from flight.link.modes import Mode
from flight.link.telemetry.form import Alarms, Level, States

TABLES: States = ((0, "configuration"), (1, "loaded"))
"""Where the table of parameters comes from that flies."""
NO_YES: States = ((0, "no"), (1, "yes"))
MODES: States = tuple((int(mode), mode.label) for mode in Mode)
SEVERITIES: States = tuple((int(severity), severity.name.lower()) for severity in Severity)
STEERING: States = ((0, "off"), (1, "following"), (2, "holding"), (3, "braking"))
"""The use of the coils (`flight.loop.body.SteeringState`)."""
STREAMS: States = ((0, "not-fitted"), (1, "never"), (2, "stale"), (3, "invalid"), (4, "slow"), (5, "good"))
"""The quality of a stream of readings (`flight.loop.fdir.facts.StreamLimitsLimitsState`)."""
KNOWLEDGE: States = ((0, "lost"), (1, "coarse"), (2, "fine"))
"""How well the attitude is known (`flight.bodies.orbit.view`)."""
COILS: States = ((0, "x"), (1, "y"), (2, "z"))
"""The coils, by body axis."""
STAGES: States = ((1, "accepted"), (2, "refused"), (3, "started"), (4, "completed"), (5, "failed"))
"""The stages of a command (`flight.link.process.verification.Stage`)."""

SAFE_ALARM: Alarms = ((int(Mode.SAFE), "warning"),)
SEVERITY_ALARMS: Alarms = ((int(Severity.WARNING), "warning"), (int(Severity.FAULT), "fault"))
STREAM_ALARMS: Alarms = ((1, "fault"), (2, "fault"), (3, "fault"), (4, "warning"))
LOST_ALARM: Alarms = ((0, "warning"),)

_FACTS: tuple[tuple[str, Level], ...] = (
    ("boot-waits", "warning"),
    ("task-failing", "fault"),
    ("no-progress", "fault"),
    ("imu-silent", "fault"),
    ("imu-unusable", "fault"),
    ("imu-line-lost", "fault"),
    ("control-lost", "fault"),
    ("blind", "fault"),
    ("tumbling", "warning"),
    ("hold-impossible", "fault"),
    ("slew-late", "warning"),
    ("holding", "warning"),
    ("coil-fault", "fault"),
    ("coil-x-broken", "fault"),
    ("coil-y-broken", "fault"),
    ("coil-z-broken", "fault"),
    ("coil-suspect", "warning"),
    ("commands-doubted", "warning"),
    ("power-doubted", "warning"),
    ("power-fault", "warning"),
    ("camera-lost", "warning"),
    ("log-fault", "fault"),
    ("cpu-high", "warning"),
    ("memory-grows", "warning"),
    ("memory-high", "fault"),
    ("disk-low", "warning"),
    ("hot", "warning"),
    ("too-hot", "fault"),
    ("imu-poor", "warning"),
    ("field-poor", "warning"),
    ("coils-poor", "warning"),
    ("power-poor", "warning"),
    ("camera-poor", "warning"),
    ("service-failing", "fault"),
    ("camera-late", "warning"),
    ("vision-slow", "warning"),
    ("gps-lost", "warning"),
    ("gps-poor", "warning"),
    ("strings-lost", "warning"),
    ("sun-unclear", "warning"),
    ("clock-off", "warning"),
    ("field-refused", "warning"),
    ("wide-lost", "warning"),
    ("wide-false", "warning"),
)
"""The facts that monitors keep, in the order of `flight.loop.fdir.facts`, as grave as their events."""
FACTS: States = tuple((bit, name) for bit, (name, _) in enumerate(_FACTS))
FACT_ALARMS: Alarms = tuple((bit, level) for bit, (_, level) in enumerate(_FACTS))
