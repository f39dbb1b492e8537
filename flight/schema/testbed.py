"""The configuration of the testbed: sections in addition to those that all bodies share."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import msgspec
from msgspec import Meta

from flight.schema.document import ConfigError
from flight.schema.sections import Config, Detumble, Estimation
from flight.schema.values import Q2, NotNegative, Positive, Section


class Plant(Section, frozen=True, kw_only=True):
    """The flight application's model of body and actuator (Sease thesis, tables 5.1, 5.3 and 5.4)."""

    inertia: Annotated[float, Meta(gt=0.0, le=1e3)]
    coil_turns: Annotated[int, Meta(gt=0, le=100_000)]
    coil_area: Annotated[float, Meta(gt=0.0, le=100.0)]
    field: Annotated[float, Meta(gt=0.0, le=1.0)]
    thread_stiffness: NotNegative = 0.0
    thread_damping: NotNegative = 0.0


class ThreadEstimation(Estimation, frozen=True, kw_only=True):
    """The testbed's filter, which also estimates changes of the plant's torsion (1/s^2) and damping (1/s)."""

    torsion_start: NotNegative = 0.02
    damping_start: NotNegative = 4.0e-3


class BdotDetumble(Detumble, frozen=True, kw_only=True):
    """Detumbling by B-dot (`knightcube.gnc.control.detumble`).

    Each cycle removes the fraction `share` of the rate, as far as the coils' limits permit. If the direction
    of the field rotates at `field_turn` rad/s, the fraction `share` is computed from this rate. On a testbed
    without a cage, `field_turn` is zero.
    """

    share: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.3
    field_turn: NotNegative = 0.0


class Guidance(Section, frozen=True, kw_only=True):
    """Path planning by virtual motion camouflage (Sease thesis, eqs. 5.8-5.15).

    The planning strategies are described in `flight.bodies.testbed.control`.

    Paths minimise the energy `cost`: the heat R I^2 of the mean current, or the supplied power V |I|.
    """

    strategy: Literal["goal", "receding", "step"] = "goal"
    horizon: Positive = 10.0
    cost: Literal["heat", "supply"] = "heat"
    time_price: Positive | None = None
    current_share: Annotated[float, Meta(ge=0.5, le=1.0)] = 0.95
    replan_period: Positive = 5.0
    late_after: Positive = 1.0
    nodes: Annotated[int, Meta(ge=8, le=40)] | None = None


class PidGains(Section, frozen=True, kw_only=True):
    """Gains of the PID controller for the angle (1/s^2), its integral (1/s^3) and the rate (1/s)."""

    proportional: Positive
    integral: Positive
    derivative: Positive


class Control(Section, frozen=True, kw_only=True):
    """The controller.

    The controllers `lq` and `thesis` use the weights of the Sease thesis, eqs. 5.30-5.32: Q = state_weight I
    and R = control_weight. The controllers `pid` and `adaptive` use `bandwidth`. The value `target_weight`
    belongs to `pid`, and `adaptation` and `reference_bandwidth` belong to `adaptive`. If `gains` are given,
    `pid` uses them instead of the bandwidth. The controller `excitation` is used by `knightcube identify`.
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
    """Motion of the body during `knightcube identify`.

    The coils use at most the fraction `current_share` of their current limit. The body stays within
    `largest_q2`, and each free oscillation lasts `swing` s.
    """

    current_share: Annotated[float, Meta(gt=0.0, le=0.9)] = 0.6
    largest_q2: Annotated[float, Meta(ge=0.05, le=0.5)] = 0.4
    swing: Positive = 45.0


class Step(Section, frozen=True, kw_only=True):
    """One commanded attitude: `q2` at mission time `at` (s), then rotation at `rate` rad/s."""

    at: NotNegative
    q2: Q2
    rate: Annotated[float, Meta(ge=-0.1, le=0.1)] = 0.0


class Cage(Section, frozen=True, kw_only=True):
    """A Helmholtz cage that reproduces the magnetic field of an orbit by UTC (`bodies.testbed.control`).

    The orbit is given by the two-line elements `elements`, and `scale` is the ratio of the cage's field to
    the orbit's field. With a cage, `plant.field` is the weakest field that plans assume.
    """

    elements: tuple[str, str]
    scale: Annotated[float, Meta(gt=0.0, le=100.0)] = 10.0


class TestbedConfig(Config, frozen=True, kw_only=True):
    """The testbed's configuration."""

    __test__ = False  # without this, pytest would collect the class

    plant: Plant
    estimation: ThreadEstimation = ThreadEstimation()
    detumble: BdotDetumble = BdotDetumble()
    guidance: Guidance = Guidance()
    control: Control = Control()
    identification: Identification = Identification()
    steps: Annotated[tuple[Step, ...], Meta(min_length=1)]
    cage: Cage | None = None

    def field_range(self) -> tuple[float, float]:
        """Return the minimum and the maximum strength (T) of a valid magnetometer reading."""
        return 0.2 * self.plant.field, 3.0 * self.plant.field

    def replan_period(self) -> float:
        """Return the time (s) from one periodic plan, which starts from the newest estimate, to the next."""
        return self.guidance.replan_period

    def hardware(self) -> tuple[Section, ...]:
        """Return the hardware sections on which the validity of learned parameters depends."""
        return (self.plant, *super().hardware())

    def shortened(self, duration: float) -> Self:
        """Return the configuration with another flight duration (s), without the steps after its end."""
        steps = tuple(step for step in self.steps if step.at < duration)
        return msgspec.structs.replace(self, duration=duration, steps=steps)


def as_testbed(config: Config) -> TestbedConfig:
    """Return a configuration of the testbed unchanged. Raises ConfigError for any other body."""
    if not isinstance(config, TestbedConfig):
        raise ConfigError("body", f"is {config.body}: this needs a configuration of the testbed")
    return config
