"""Opens the kept state of a boot, where there is a place for it, and sees to its end."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path

from flight.loop.state.keeper import Notices, StateKeeper
from flight.loop.state.learning import digest_of
from flight.loop.state.store import StateStore
from flight.schema.sections import Config
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import Clock


def state_folder(config: Config, environment: Mapping[str, str]) -> Path | None:
    """Return where the state is kept: as configured, else systemd's folder where real devices are flown."""
    if config.state.folder is not None:
        return Path(config.state.folder)
    if config.simulation is not None:
        return None
    return service_folder(environment)


def service_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the state folder that systemd gives a service, None where there is none."""
    # systemd puts colons between several folders; the first is the application's own.
    first = environment.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(first) if first else None


def open_state(
    config: Config, environment: Mapping[str, str], clock: Clock, stack: ExitStack
) -> StateKeeper | None:
    """Count this boot; None where no state is kept.

    `stack` ends it: cleanly, unless an exception passes. A device that does not answer is no crash: it is
    told, and safe mode would not mend it.
    """
    folder = state_folder(config, environment)
    if folder is None:
        return None
    with suppress(OSError):  # the first write will fail and tell; the flight goes on
        folder.mkdir(parents=True, exist_ok=True)
    notices = Notices()
    keeper = StateKeeper(
        StateStore(folder, notices.report),
        notices,
        clock,
        window=config.modes.crash_window,
        devices=digest_of(config),
        period_ns=round(config.state.period * 1e9),
    )

    def close(kind: type[BaseException] | None, *_: object) -> bool:
        keeper.close(clean=kind is None or issubclass(kind, DeviceError))
        return False

    stack.push(close)
    return keeper
