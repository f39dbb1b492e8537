"""Mean power of an ideal controller that knows the true plant and all disturbances in advance."""

from __future__ import annotations

from flight.schema.bodies import TestbedConfig
from knightcube.gnc.guidance.plant import SingleAxisPlant, angle_of
from sim_hal.settings import Simulation
from tests.support.collocation_oracle import Slew, solve

REACHED_AFTER = 10.0


def clairvoyant_power(config: TestbedConfig, world: Simulation) -> float:
    """Return the mean R I^2 (W) of the optimum for a demonstration's steps in a fully known world."""
    true = SingleAxisPlant(
        world.truth.inertia or config.plant.inertia,
        config.plant.coil_turns * config.plant.coil_area * (world.truth.field or config.plant.field),
        (world.truth.resistance or config.coils.resistance)[0],
        config.coils.current_limit,
        world.thread.stiffness,
        world.thread.damping,
    )
    assert world.release is not None, "the testbed has one"
    angle, rate = angle_of(world.release.q2), world.release.rate
    ends = [step.at for step in config.steps[1:]] + [config.duration]
    energy = 0.0
    for step, end in zip(config.steps, ends, strict=True):
        target = angle_of(step.q2)
        slew = Slew(
            angle,
            rate,
            target,
            0.0,
            REACHED_AFTER,
            true.inertia,
            true.torque_constant,
            true.resistance,
            true.current_limit,
            true.stiffness,
            true.damping,
        )
        best = solve(slew, intervals=800)
        if best is None:
            raise ValueError(f"no trajectory reaches q2 {step.q2} in {REACHED_AFTER} s")
        held = true.current(target, 0.0, 0.0)
        energy += best.energy + true.resistance * held * held * (end - step.at - REACHED_AFTER)
        angle, rate = target, 0.0
    return energy / config.duration
