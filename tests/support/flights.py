"""Short flights on simulated hardware, with faults of devices and lines, for the scenario tests."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from flight.app import flight as opening
from flight.app.flight import next_whole_second
from flight.link.telemetry.packets import to_text
from flight.loop.flight_loop import FlightLoop, RunLabel
from flight.schema import reader as configuration
from flight.schema.bodies import TestbedConfig, as_testbed
from flight.schema.sections import Commands, CommandStep, Config, Modes
from ground.telemetry import Run, read_run
from hal.interfaces.wires import SECOND_NS
from sim_hal.rig import LockStep, opened_lockstep, with_host_faults
from sim_hal.settings import Simulation
from sim_hal.worlds.testbed import Testbed

CONFIG = Path(__file__).resolve().parents[2] / "config" / "step_demo.yaml"
TEXT = CONFIG.read_text(encoding="utf-8")
DURATION = 26.0
"""Duration (s) of a flight with one fault."""
FRAME_PERIOD, FRAME_EXPOSURE, FRAME_LATE = 2.0, 0.2, 1.0
"""Frame period, exposure and result timeout (s) of the camera in flights with a fault."""


@dataclass(frozen=True)
class Rigged:
    """A prepared run. The method `at` schedules an action at a mission time (s)."""

    lock: LockStep
    loop: FlightLoop
    epoch_ns: int

    @property
    def testbed(self) -> Testbed:
        """The simulated world, which must be the testbed."""
        world = self.lock.hardware.world
        assert isinstance(world, Testbed)
        return world

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        self.lock.hardware.faults.at(self.epoch_ns + round(seconds * SECOND_NS), action)


def demo_config(duration: float, camera: bool = True) -> TestbedConfig:
    """Return the step demonstration, shortened to `duration` s."""
    config = _demo()
    steps = tuple(step for step in config.steps if step.at < duration)
    changed = configuration.replace(config, duration=duration, steps=steps)
    return changed if camera else configuration.replace(changed, camera=None)


@cache
def _demo() -> TestbedConfig:
    """Return the configuration of the whole demonstration, which is read only once."""
    return as_testbed(configuration.parse(TEXT))


@cache
def demo_world() -> Simulation:
    """Return the world of the step demonstration."""
    section = configuration.simulation_section(TEXT, CONFIG.name, Simulation)
    assert section is not None
    return section


def thesis_config(duration: float) -> TestbedConfig:
    """Return the demonstration without a camera, with the thesis's receding-horizon planner and tracker."""
    config = demo_config(duration, camera=False)
    guidance = configuration.replace(config.guidance, strategy="receding", current_share=1.0)
    control = configuration.replace(config.control, tracker="thesis", state_weight=20.0)
    estimation = configuration.replace(config.estimation, gate_sigma=5.0)
    return configuration.replace(config, guidance=guidance, control=control, estimation=estimation)


def fly(
    config: Config,
    folder: Path,
    prepare: Callable[[Rigged], None] = lambda _: None,
    seed: int = 1,
    planner_latency: float | None = None,
    section: Simulation | None = None,
    absent: Callable[[LockStep], None] | None = None,
) -> Run:
    """Run a configuration in lock-step, and return its logs. The function `prepare` may schedule faults.

    `section` describes the simulated world and its seed; the default is the world of the demonstration.
    The function `absent` may remove devices before they are opened; the run then waits for them. The coil
    currents must be zero after the devices were closed, whatever ended the flight.
    """
    folder.mkdir(parents=True, exist_ok=True)
    section = section or configuration.replace(demo_world(), seed=seed)
    with ExitStack() as stack:
        lock = stack.enter_context(opened_lockstep(config, section, folder))
        # No command can end the current of a bridge leg that is stuck high.
        if not any("-high" in entry.fault for entry in section.faults):
            stack.callback(lambda: _assert_off(lock))
        planner_s = section.latency.planner if planner_latency is None else planner_latency
        latency = round(planner_s * SECOND_NS), round(section.latency.vision * SECOND_NS)
        rig = lock.rig(section.seed, latency)
        rig = with_host_faults(rig, section)
        if absent is not None:
            absent(lock)
        loop, _ = opening.open_flight(config, rig, folder, stack, patient=absent is not None)
        epoch_ns = next_whole_second(lock.clock)
        rig.release(epoch_ns)
        prepare(Rigged(lock, loop, epoch_ns))
        loop.run(epoch_ns, RunLabel(TEXT, section.seed, True, False))
    return read_run(folder)


def _assert_off(lock: LockStep) -> None:
    pwm = lock.hardware.pwm
    assert not lock.hardware.circuit.currents().any()
    assert all(pwm.duty(channel) == 0.0 for channel in range(16)), "both inputs of each bridge are low"


def event_names(run: Run) -> list[str]:
    """Return the names of a run's events, in order."""
    return [to_text(name) for name in run["event"]["name"]]


def event_time(run: Run, name: str) -> float:
    """Return the mission time (s) of the first event named `name`."""
    return float(run["event"]["time_ns"][event_names(run).index(name)]) * 1e-9


def config_for(mode: str, camera: bool, duration: float = DURATION) -> Config:
    """Return the demonstration, shortened to half a minute in one mode, or with a small and fast camera."""
    config = demo_config(duration)
    eye = None
    if camera and config.camera is not None:
        eye = configuration.replace(
            config.camera,
            columns=512,
            rows=512,
            exposure=FRAME_EXPOSURE,
            period=FRAME_PERIOD,
            max_age=4.5,
            late_after=FRAME_LATE,
        )
    timeline: tuple[CommandStep, ...] = ()
    initial = mode
    if mode == "slew":
        initial, timeline = "hold", (CommandStep(at=3.5, slew=-0.3), CommandStep(at=14.0, slew=0.1))
    elif mode == "boot":
        initial = "testbed-demo"
    return configuration.replace(
        config,
        camera=eye,
        modes=configuration.replace(Modes(), initial=initial),
        commands=configuration.replace(Commands(), timeline=timeline),
    )
