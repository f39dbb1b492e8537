"""Opens the stored state of a boot, where there is a folder for it, and closes it at the flight's end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from flight.loop.state.keeper import Notices, StateKeeper
from flight.loop.state.learning import digest_of
from flight.loop.state.store import StateStore
from flight.loop.state.witness import newest_boot, note_boot
from flight.schema.sections import Config
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import Clock


def state_folder(config: Config, environment: Mapping[str, str]) -> Path | None:
    """Return the state's folder: as configured, else systemd's for a flight of real devices, else None."""
    if config.state.folder is not None:
        return Path(config.state.folder)
    if config.simulation is not None:
        return None
    return service_folder(environment)


def service_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the state folder that systemd gives a service, None without one."""
    # systemd separates several folders by colons; the first is the application's own.
    first = environment.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(first) if first else None


def open_state(
    config: Config,
    environment: Mapping[str, str],
    clock: Clock,
    stack: ExitStack,
    runs: Sequence[Path] = (),
) -> StateKeeper | None:
    """Count this boot; return None where no state is stored.

    `runs` are the folders of the newest runs, this one the last: the boot's number is noted in them.
    `stack` closes the state: cleanly, unless an exception passes. A DeviceError counts as clean: the device
    is reported, and safe mode would not help.
    """
    folder = state_folder(config, environment)
    if folder is None:
        return None
    with suppress(OSError):  # the first write will fail and be reported; the flight goes on
        folder.mkdir(parents=True, exist_ok=True)
    notices = Notices()
    keeper = StateKeeper(
        StateStore(folder, notices.report),
        notices,
        clock,
        window=config.modes.crash_window,
        devices=digest_of(config),
        period_ns=round(config.state.period * 1e9),
        boots=newest_boot([folder, *runs]),
    )
    if keeper.counted:
        note_boot([folder, *runs[-1:]], keeper.record.boot_count)

    def close(kind: type[BaseException] | None, *_: object) -> bool:
        keeper.close(clean=kind is None or issubclass(kind, DeviceError))
        return False

    stack.push(close)
    return keeper
