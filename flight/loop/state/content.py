"""The stored state: its content, how it changes from boot to boot, and the learned parameters in it.

The state is typed, bounded and validated. UTC is a label for people, never used in computations. Crashes are
counted per operating time, the sum over all boots of monotonic running time: a wrong or stepped clock has no
effect, and a board that crashes at once, repeatedly, does not age its crashes out.

The learned parameters are the parts of an estimate that belong to the devices, not to the motion. The next
boot starts from them, with the covariance increased by a fraction of the configured prior, for changes
meanwhile. Values that the prior makes implausible are rejected.
"""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import (
    BIAS,
    FIELD_BIAS,
    LATENCY,
    PARAMETERS,
    Estimate,
    Parameters,
    SlowPrior,
)

Count = Annotated[int, Meta(ge=0, le=2**53)]
Seconds = Annotated[float, Meta(ge=0.0)]
LONGEST_LABEL = 32
Label = Annotated[str, Meta(max_length=LONGEST_LABEL)]

REMEMBERED = 32
"""How many unclean shutdowns are kept, the newest."""


class StatePart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the state; unknown keys are rejected."""


class Learned(StatePart, frozen=True):
    """Parameters learned in flight: `values` (n,) and their covariance (n, n), by rows, in SI units."""

    values: Annotated[tuple[float, ...], Meta(min_length=1, max_length=16)]
    covariance: tuple[tuple[float, ...], ...]

    @staticmethod
    def of(values: FloatArray, covariance: FloatArray) -> Learned:
        """Return the stored form of arrays; the covariance is made exactly symmetric."""
        even = 0.5 * (covariance + covariance.T)
        return Learned(tuple(values.tolist()), tuple(map(tuple, even.tolist())))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Return values (n,) and covariance (n, n)."""
        return np.array(self.values), np.array(self.covariance)


class UncleanShutdown(StatePart, frozen=True):
    """An unclean shutdown: boot number, and operating time and UTC label of its last stored state."""

    boot: Count
    operated: Seconds
    utc: Label


class KeptTable(StatePart, frozen=True, kw_only=True):
    """A table of parameters that was loaded: values by the configuration's keys.

    Attributes:
        before: the values that flew before it, empty for those of the configuration.
        proven: whether it has flown long enough to be trusted after an unclean shutdown.
        loads: tables loaded so far.
    """

    values: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    before: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    proven: bool = True
    loads: Count = 0


class StoredState(StatePart, frozen=True, kw_only=True, omit_defaults=True):
    """The stored state.

    Attributes:
        boot_count: how often the application has started.
        operated: s, total operating time by the monotonic clock: the time scale of crash counts.
        running: set at the start and cleared at a clean end.
        unclean: unclean shutdowns, oldest first.
        mode: the mode at the last write.
        utc: a label of the last write.
        learned: parameters by name.
        devices: digest of the configuration of the devices that the parameters belong to.
        table: the table of parameters that an operator loaded.
    """

    boot_count: Count = 0
    operated: Seconds = 0.0
    running: bool = False
    unclean: Annotated[tuple[UncleanShutdown, ...], Meta(max_length=REMEMBERED)] = ()
    mode: Label = ""
    utc: Label = ""
    learned: Annotated[dict[Label, Learned], Meta(max_length=32)] = {}
    devices: Label = ""
    table: KeptTable = KeptTable()


def check(state: StoredState) -> None:
    """Raise ValueError for a state that must not be stored: a non-finite number, an invalid covariance."""
    if not all(
        math.isfinite(t) for t in (state.operated, *(shutdown.operated for shutdown in state.unclean))
    ):
        raise ValueError("an operating time is not finite")
    tables = (state.table.values, state.table.before)
    if not all(math.isfinite(value) for table in tables for value in table.values()):
        raise ValueError("a parameter is not finite")
    for name, learned in state.learned.items():
        size = len(learned.values)
        if [len(row) for row in learned.covariance] != [size] * size:
            raise ValueError(f"{name}: the covariance of {size} values is no {size} x {size} matrix")
        values, covariance = learned.arrays()
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise ValueError(f"{name}: a value or its covariance is not finite")
        if not np.array_equal(covariance, covariance.T):
            raise ValueError(f"{name}: the covariance is not symmetric")
        scale = float(np.max(np.abs(covariance)))
        if scale > 0.0 and float(np.linalg.eigvalsh(covariance / scale)[0]) < -1e-9:
            raise ValueError(f"{name}: the covariance has a negative eigenvalue")


@dataclass(frozen=True, slots=True)
class BootRecord:
    """The history of earlier boots, as needed at the start.

    Attributes:
        boot_count: this boot's number, 1 the first.
        unclean_recent: unclean shutdowns within the given window of operating time.
        after_unclean: whether the previous boot ended uncleanly.
        mode: the mode at the last stop; empty when there was none.
    """

    boot_count: int
    unclean_recent: int
    after_unclean: bool
    mode: str


@dataclass(frozen=True, slots=True)
class Noted:
    """The loop's values for the next write: the mode, the learned parameters, and the table of parameters."""

    mode: str
    learned: Mapping[str, Learned]
    table: KeptTable


def begin_boot(state: StoredState, utc: str, devices: str = "") -> StoredState:
    """Return the state of the next boot: running, and with a crash of the last boot recorded.

    Parameters learned of other `devices` are discarded, and a loaded table that a crash left unproven.
    """
    unclean = state.unclean
    if state.running:
        unclean = (*unclean, UncleanShutdown(state.boot_count, state.operated, state.utc))[-REMEMBERED:]
    return msgspec.structs.replace(
        state,
        boot_count=state.boot_count + 1,
        running=True,
        unclean=unclean,
        utc=utc,
        learned=state.learned if state.devices == devices else {},
        devices=devices,
        table=_trusted(state.table) if state.running else state.table,
    )


def _trusted(table: KeptTable) -> KeptTable:
    """Return the table to fly after an unclean shutdown: the previous table if this one is not proven."""
    if table.proven:
        return table
    return msgspec.structs.replace(table, values=table.before, before={}, proven=True)


def state_after(begun: StoredState, elapsed: float, noted: Noted, utc: str) -> StoredState:
    """Return the state `elapsed` s after the start `begun`; new learned parameters replace the old."""
    return msgspec.structs.replace(
        begun,
        operated=begun.operated + max(elapsed, 0.0),
        mode=noted.mode[:LONGEST_LABEL] or begun.mode,
        learned={**begun.learned, **noted.learned},
        table=noted.table,
        utc=utc,
    )


def end_cleanly(state: StoredState) -> StoredState:
    """Return the state after a clean end_cleanly."""
    return msgspec.structs.replace(state, running=False)


def boot_record(begun: StoredState, window: float) -> BootRecord:
    """Return the boot record of the state of a new boot; `window` in s of operating time."""
    recent = sum(begun.operated - shutdown.operated <= window for shutdown in begun.unclean)
    after = bool(begun.unclean) and begun.unclean[-1].boot == begun.boot_count - 1
    return BootRecord(begun.boot_count, recent, after, begun.mode)


GYRO_BIAS, PLANT, IMU_LATENCY, MAGNETOMETER_BIAS = "gyro-bias", "plant", "imu-latency", "magnetometer-bias"

_BELIEVED = 4.0
"""Sigmas of the configured prior: learned values further from the prior are rejected."""


def learned_of(estimate: Estimate) -> dict[str, Learned]:
    """Return the estimate's slow parts by name, in its units and axes.

    The gyro's bias; torsion, damping and coil gain of the plant; the age of the inertial unit's samples; the
    magnetometer's bias. Cross-covariances are dropped.
    """
    parts: dict[str, tuple[FloatArray, slice]] = {
        GYRO_BIAS: (estimate.bias, BIAS),
        PLANT: (np.array(estimate.parameters), PARAMETERS),
        IMU_LATENCY: (np.array([estimate.latency]), slice(LATENCY, LATENCY + 1)),
        MAGNETOMETER_BIAS: (estimate.field_bias, FIELD_BIAS),
    }
    return {
        name: Learned.of(values, estimate.covariance[where, where]) for name, (values, where) in parts.items()
    }


def digest_of(config: Config) -> str:
    """Return a digest of the devices of a configuration."""
    return f"{zlib.crc32(msgspec.json.encode(config.hardware())):08x}"


def start_from(
    learned: Mapping[str, Learned], configured: SlowPrior, changed: float
) -> tuple[SlowPrior, list[str]]:
    """Return the filter's prior, and why learned parameters were rejected.

    `configured` is the prior without learning; since the last boot a value may have changed by the fraction
    `changed` of its standard deviation in `configured`.
    """
    problems: list[str] = []

    def accept(name: str, values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        if name not in learned:
            return values, covariance
        found, spread = learned[name].arrays()
        problem = _problem(found, values, covariance)
        if problem:
            problems.append(f"{name} {found.tolist()}: {problem}")
            return values, covariance
        return _widened(found, spread, values, covariance, changed)

    bias, bias_covariance = accept(GYRO_BIAS, configured.bias, configured.bias_covariance)
    plant, plant_covariance = accept(PLANT, np.array(configured.parameters), configured.parameters_covariance)
    age, age_covariance = accept(
        IMU_LATENCY, np.array([configured.latency]), np.array([[configured.latency_variance]])
    )
    torsion, damping, gain = plant.tolist()
    prior = dataclasses.replace(
        configured,
        bias=bias,
        bias_covariance=bias_covariance,
        parameters=Parameters(torsion, damping, gain),
        parameters_covariance=plant_covariance,
        latency=float(age[0]),
        latency_variance=float(age_covariance[0, 0]),
    )
    return prior, problems


def _problem(found: FloatArray, values: FloatArray, covariance: FloatArray) -> str:
    """Return why a learned value is implausible; empty when plausible."""
    if found.shape != values.shape:
        return f"{len(values)} values are wanted"
    sigma = np.sqrt(np.diag(covariance))
    if np.any((sigma > 0.0) & (np.abs(found - values) > _BELIEVED * sigma)):
        return f"not within {_BELIEVED:g} sigma of {values.tolist()} +- {sigma.tolist()}"
    return ""


def _widened(
    found: FloatArray, spread: FloatArray, values: FloatArray, covariance: FloatArray, changed: float
) -> tuple[FloatArray, FloatArray]:
    """Return learned values with the increased covariance; values not estimated stay as configured."""
    variance = np.diag(covariance)
    estimated = variance > 0.0
    both = np.outer(estimated, estimated)
    wide = np.where(both, spread, 0.0) + np.diag(changed**2 * variance)
    return np.where(estimated, found, values), wide
