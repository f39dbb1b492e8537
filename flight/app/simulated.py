"""Where the flight application meets the simulator: by one module, `sim_hal.rig`, and only when asked.

On board none of it is imported.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from flight.app.request import RunRequest
from flight.schema.sections import Config
from hal.interfaces.wires import Rig
from knightcube.astro.arrays import FloatArray

if TYPE_CHECKING:
    from sim_hal.rig import PosedCamera, SimulationRequest


def fault_catalogue() -> tuple[str, str]:
    """Return how faults of a simulation are written, and a list of all."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.fault_catalogue()


def corrupted_text(request: RunRequest, text: str) -> str:
    """Return a configuration as the requested faults corrupt it; unchanged where none does."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.corrupted_text(request.faults, text, request.seed)


def injected_faults(request: RunRequest, text: str) -> tuple[str, ...]:
    """Return the faults of a flight as they are written, the configuration's first."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.injected_faults(_simulation_request(request, text))


def simulated_rig(request: RunRequest, text: str, config: Config, stack: ExitStack) -> Rig:
    """Open the emulated devices of a configuration, with the request's faults. Raises UsageError."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.open_rig(_simulation_request(request, text), config, stack)


def simulated_camera(config_path: Path, text: str, config: Config, rate: FloatArray) -> PosedCamera:
    """Return the emulated camera of a configuration, turning at `rate` (3,) rad/s in camera axes."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.open_camera(rig.SimulationRequest(config_path, text, Path()), config, rate)


def _simulation_request(request: RunRequest, text: str) -> SimulationRequest:
    from sim_hal.rig import SimulationRequest  # noqa: PLC0415

    return SimulationRequest(
        request.config_path,
        text,
        request.out,
        request.realtime,
        request.seed,
        request.devices,
        request.faults,
    )
