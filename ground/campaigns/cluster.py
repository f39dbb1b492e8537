"""Campaigns on a Dask cluster whose machines have the dependencies, but not the packages of this project.

A plugin sends the project's packages to every worker, also to workers that join later. A case is sent as
data, with the name of the function that runs the case. This module itself is pickled by value, so that
scheduler and workers can read it without the packages. The top level of this module must therefore import
neither the packages nor Dask.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import os
import shutil
import sys
import threading
import zipfile
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

PACKAGES = ("knightcube", "flight", "ground", "hal", "sim_hal", "tests")
FOLDERS = (*PACKAGES, "config")
_ROOT = Path(__file__).parents[2]
_PLUGIN = "knightcube-code"
_SENT = (".py", ".npz", ".npy", ".yaml", ".yml", ".json", ".csv", ".txt", ".c", ".png")
CONNECT_S = 15.0
"""Maximum time (s) to wait for the scheduler's answer, and for the first worker."""

_one_case = threading.Lock()


class ShippedCode:
    """Plugin that unpacks the packages into a worker's own folder, and makes the worker import them."""

    name = _PLUGIN
    idempotent = False

    def __init__(self, archive: bytes) -> None:
        self._archive = archive
        self.version = hashlib.sha256(archive).hexdigest()[:16]

    def setup(self, worker: Any) -> None:
        """Unpack the packages, and unload the modules of packages that were sent earlier."""
        folder = Path(worker.local_directory) / f"{_PLUGIN}-{self.version}"
        if not folder.is_dir():
            beside = folder.with_name(f"{folder.name}-{os.getpid()}")
            with zipfile.ZipFile(io.BytesIO(self._archive)) as archive:
                archive.extractall(beside)
            try:
                beside.rename(folder)
            except OSError:  # another worker has already unpacked the packages into this folder
                shutil.rmtree(beside)
        sys.path[:] = [str(folder), *(place for place in sys.path if _PLUGIN not in place)]
        for name in [name for name in sys.modules if name.split(".")[0] in PACKAGES]:
            del sys.modules[name]
        importlib.invalidate_caches()
        os.environ["KNIGHTCUBE_CODE"] = self.version

    def teardown(self, worker: Any) -> None:
        """Do nothing, because the worker itself deletes its folder with the unpacked packages."""


def carry_out(version: str, module: str, function: str, case: dict[str, Any]) -> Any:
    """Run a case with the packages of `version`.

    Return None if the worker has a different version of the packages.
    """
    if os.environ.get("KNIGHTCUBE_CODE") != version:
        return None
    sent = importlib.import_module("ground.campaigns.cluster")
    return sent.run_alone(module, function, case)


def run_alone(module: str, function: str, case: dict[str, Any]) -> Any:
    """Run a case while no other case runs in this process, because flights do not support threads."""
    campaign = importlib.import_module("ground.campaigns.runner")
    with _one_case:
        return getattr(importlib.import_module(module), function)(campaign.Case(**case))


def archive_of(root: Path) -> bytes:
    """Return the packages below a folder as a zip file. Identical files give identical bytes."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for top in FOLDERS:
            # The folder flight/schema contains a symbolic link to config/.
            for folder, below, files in os.walk(root / top, followlinks=True):
                below[:] = sorted(name for name in below if name != "__pycache__")
                for name in sorted(files):
                    if name.endswith(_SENT):
                        path = Path(folder) / name
                        entry = zipfile.ZipInfo(str(path.relative_to(root)))
                        archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)
    return held.getvalue()


def finished(
    address: str, run: Callable[[Any], Any], cases: Sequence[Any], report: Callable[[str], None]
) -> Generator[tuple[str, Any], None, None]:
    """Run cases on the cluster of the scheduler at `address`, and yield key and result of each case.

    If a worker dies, other workers run its cases. The function `report` shows a line of text about the
    cluster. Raises UsageError if no cluster is found at the start, and CampaignError if the scheduler is lost
    or a case kills every worker that runs it.
    """
    distributed, cloudpickle = map(importlib.import_module, ("distributed", "cloudpickle"))

    def carried(*words: Any) -> Any:
        """Call `carry_out`. This inner function is pickled by value, with the functions that it calls."""
        return carry_out(*words)

    here = sys.modules[__name__]
    cloudpickle.register_pickle_by_value(here)
    try:
        with _client(address) as client:
            plugin = type("Shipped", (ShippedCode, distributed.WorkerPlugin), {})(archive_of(_ROOT))
            client.register_plugin(plugin, name=_PLUGIN)
            workers = len(client.scheduler_info(n_workers=-1)["workers"])
            report(f"cluster at {address}, workers: {workers}, dashboard: {client.dashboard_link}")
            futures = {
                client.submit(
                    carried,
                    plugin.version,
                    run.__module__,
                    run.__name__,
                    {"key": case.key, "seed": case.seed, "parameters": case.parameters},
                    pure=False,
                ): case.key
                for case in cases
            }
            for future in distributed.as_completed(futures):
                yield futures[future], _result(future, futures[future], address)
    finally:
        cloudpickle.unregister_pickle_by_value(here)


def _client(address: str) -> Any:
    """Return a client of a scheduler that has at least one worker. Raises UsageError."""
    from knightcube.errors import UsageError  # noqa: PLC0415 - see the docstring of the module

    try:
        client = importlib.import_module("distributed").Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        first = str(error).splitlines()[0]
        raise UsageError(f"--dask {address}: no scheduler answers there ({first})") from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        client.close()
        raise UsageError(
            f"--dask {address}: the scheduler has no worker: start `dask worker {address}`"
        ) from error
    return client


def _result(future: Any, key: str, address: str) -> Any:
    """Return the result of a case. Raises CampaignError, or the exception that the case raised."""
    from ground.campaigns import CampaignError  # noqa: PLC0415

    distributed = importlib.import_module("distributed")
    try:
        result = future.result()
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise CampaignError(f"the scheduler at {address} is lost") from error
    except distributed.KilledWorker as error:
        raise CampaignError(
            f"case {key}: every worker that ran it died, such as {error.last_worker}: check its memory"
        ) from error
    if result is None:
        raise CampaignError(
            f"other packages were sent to the cluster at {address}: only one checkout at a time can use it"
        )
    return result
