"""The shape of the testbed's configuration: its own sections beside those of every body."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import msgspec
from msgspec import Meta

from flight.schema.errors import ConfigError
from flight.schema.sections import Config, Detumble, Estimation
from flight.schema.values import Q2, NotNegative, Positive, Section


class Plant(Section, frozen=True, kw_only=True):
    """What the flight application believes about the body and its actuator (Sease Table 5.1, 5.3, 5.4)."""

    inertia: Annotated[float, Meta(gt=0.0, le=1e3)]
    coil_turns: Annotated[int, Meta(gt=0, le=100_000)]
    coil_area: Annotated[float, Meta(gt=0.0, le=100.0)]
    field: Annotated[float, Meta(gt=0.0, le=1.0)]
    thread_stiffness: NotNegative = 0.0
    thread_damping: NotNegative = 0.0


class ThreadEstimation(Estimation, frozen=True, kw_only=True):
    """The filter on the thread: also the thread's torsion, 1/s^2, and damping, 1/s, beyond the plant's."""

    torsion_start: NotNegative = 0.02
    damping_start: NotNegative = 4.0e-3


class BdotDetumble(Detumble, frozen=True, kw_only=True):
    """Detumbling by B-dot (`knightcube.gnc.control.detumble`).

    `share` of the rate is to go in each window, as far as the coils can. Where the field's direction turns by
    `field_turn` rad/s the share follows from that; zero where it stands, as on the testbed.
    """

    share: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.3
    field_turn: NotNegative = 0.0


class Guidance(Section, frozen=True, kw_only=True):
    """Virtual motion camouflage (Sease 5.8-5.15); `bodies.testbed.planning` explains the strategies.

    `cost` is the energy that paths save: R I^2 of the mean current, or V |I| taken from the supply.
    """

    strategy: Literal["goal", "receding", "step"] = "goal"
    horizon: Positive = 10.0
    cost: Literal["heat", "supply"] = "heat"
    time_price: Positive | None = None
    current_share: Annotated[float, Meta(ge=0.5, le=1.0)] = 0.95
    replan_period: Positive = 5.0
    late_after: Positive = 1.0
    max_horizon: Positive = 60.0
    nodes: Annotated[int, Meta(ge=8, le=40)] | None = None


class PidGains(Section, frozen=True, kw_only=True):
    """Free gains of the PID controller on angle (1/s^2), its integral (1/s^3) and the rate (1/s)."""

    proportional: Positive
    integral: Positive
    derivative: Positive


class Control(Section, frozen=True, kw_only=True):
    """The controller.

    `lq` and `thesis` take the weights of Sease 5.30-5.32, Q = state_weight I and R = control_weight; `pid`
    and `adaptive` the bandwidth and what follows it; `gains` replace the bandwidth of `pid`. `excitation` is
    flown by `python -m flight identify`.
    """

    tracker: Literal["lq", "thesis", "pid", "adaptive", "excitation"] = "lq"
    state_weight: Positive = 2.0
    control_weight: Positive = 1.0
    bandwidth: Positive = 1.0
    gains: PidGains | None = None
    target_weight: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    adaptation: Positive = 1.0
    reference_bandwidth: Positive | None = None


class Identification(Section, frozen=True, kw_only=True):
    """How `python -m flight identify` moves the body, and how well the plant is known beforehand.

    `*_error` are relative standard deviations of what stands in `plant`: the inertia, the coils' dipole per
    ampere (turns, area and what the resistance makes of it), the field; and of the magnetometer's scale.
    """

    current_share: Annotated[float, Meta(gt=0.0, le=0.9)] = 0.6
    largest_q2: Annotated[float, Meta(ge=0.05, le=0.5)] = 0.4
    swing: Positive = 45.0
    inertia_error: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.1
    dipole_error: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.05
    field_error: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.1
    magnetometer_error: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.02


class Step(Section, frozen=True, kw_only=True):
    """One commanded attitude: from `at` seconds of mission time reach q2 at `rate` rad/s; zero holds it."""

    at: NotNegative
    q2: Q2
    rate: Annotated[float, Meta(ge=-0.1, le=0.1)] = 0.0


class Cage(Section, frozen=True, kw_only=True):
    """A Helmholtz cage that plays an orbit's field (`bodies.testbed.cage`), by UTC.

    `elements` are the two lines of that orbit, `scale` how many times as strong the cage makes its field.
    `plant.field` is then the weakest field that plans count on.
    """

    elements: tuple[str, str]
    scale: Annotated[float, Meta(gt=0.0, le=100.0)] = 10.0


class TestbedConfig(Config, frozen=True, kw_only=True):
    """The testbed's configuration."""

    __test__ = False  # pytest: not a test, in spite of its name

    plant: Plant
    estimation: ThreadEstimation = ThreadEstimation()
    detumble: BdotDetumble = BdotDetumble()
    guidance: Guidance = Guidance()
    control: Control = Control()
    identification: Identification = Identification()
    steps: Annotated[tuple[Step, ...], Meta(min_length=1)]
    cage: Cage | None = None

    def field_range(self) -> tuple[float, float]:
        """Return the smallest and the largest strength of a valid magnetometer reading, T."""
        return 0.2 * self.plant.field, 3.0 * self.plant.field

    def replan_period(self) -> float:
        """Return how often a path is planned from the newest estimate, s."""
        return self.guidance.replan_period

    def hardware(self) -> tuple[Section, ...]:
        """Return the sections of body and devices for which learned parameters hold."""
        return (self.plant, *super().hardware())

    def shortened(self, duration: float) -> Self:
        """Return the configuration of a flight of `duration` s, without the later steps."""
        steps = tuple(step for step in self.steps if step.at < duration)
        return msgspec.structs.replace(self, duration=duration, steps=steps)


def as_testbed(config: Config) -> TestbedConfig:
    """Return a configuration as the testbed's. Raises ConfigError for another body's."""
    if not isinstance(config, TestbedConfig):
        raise ConfigError("body", f"is {config.body}: this needs a configuration of the testbed")
    return config
