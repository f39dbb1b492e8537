"""The first packet of a run: configuration, software and kind of hardware."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from flight import __version__
from flight.link.telemetry.definitions import RUN
from flight.link.telemetry.recorder import Recorder
from flight.schema.sections import Config


@dataclass(frozen=True, slots=True)
class RunLabel:
    """The properties of a run."""

    config_text: str
    seed: int
    simulated: bool
    realtime: bool


def record_run(
    recorder: Recorder, config: Config, label: RunLabel, epoch_ns: int, utc_ns: int, period_ns: int
) -> None:
    """Record the run that begins at `epoch_ns`, UTC `utc_ns`; `period_ns` is the control period."""
    coils = config.coils
    recorder.record(
        RUN,
        epoch_ns,
        config_name=config.name,
        config_crc=zlib.crc32(label.config_text.encode()),
        software=__version__,
        seed=label.seed,
        utc_ns=utc_ns,
        simulated=int(label.simulated),
        realtime=int(label.realtime),
        control_period_ns=period_ns,
        duration=config.duration,
        coil_resistance=list(coils.resistance),
        supply_voltage=coils.supply_voltage,
        current_limit=coils.current_limit,
    )
