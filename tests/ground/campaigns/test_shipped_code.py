"""Tests of the packages and results of a Dask cluster, with test doubles of Dask's scheduler and workers."""

from __future__ import annotations

import io
import os
import sys
import zipfile
from concurrent.futures import CancelledError
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from ground.campaigns import CampaignError, cluster
from ground.campaigns.cluster import ShippedCode, archive_of, finished
from ground.campaigns.runner import Case
from knightcube.errors import UsageError


def tree(root: Path) -> Path:
    """Return a folder with files that are sent and files that are not."""
    for name in (
        "flight/b.py",
        "flight/a.py",
        "flight/deep/values.yaml",
        "flight/__pycache__/a.py",
        "flight/notes.md",
        "config/one.yaml",
        "docs/page.py",
        "setup.py",
    ):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(name, encoding="utf-8")
    (root / "flight" / "linked").symlink_to(root / "config")
    return root


def test_the_archive_has_the_files_that_are_imported_in_a_fixed_order(tmp_path: Path) -> None:
    sent = archive_of(tree(tmp_path / "one"))
    with zipfile.ZipFile(io.BytesIO(sent)) as archive:
        names = archive.namelist()
        assert archive.read("flight/deep/values.yaml") == b"flight/deep/values.yaml"
        assert {one.compress_type for one in archive.infolist()} == {zipfile.ZIP_DEFLATED}
    assert names[:2] == ["flight/a.py", "flight/b.py"]
    assert names[2:4] == ["flight/deep/values.yaml", "flight/linked/one.yaml"]
    assert names[4:] == ["config/one.yaml"]
    again = tree(tmp_path / "two")
    os.utime(again / "flight" / "a.py", (1e9, 1e9))
    assert archive_of(again) == sent
    (again / "flight" / "a.py").write_text("changed")
    assert ShippedCode(archive_of(again)).version != ShippedCode(sent).version


@pytest.fixture
def interpreter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a test change the paths and modules of a copy of the interpreter's state."""
    monkeypatch.setattr(sys, "path", ["/old/knightcube-code-0123", "/usr/lib"])
    modules = {"flight": SimpleNamespace(), "flight.link": SimpleNamespace(), "flightless": SimpleNamespace()}
    monkeypatch.setattr(sys, "modules", {**sys.modules, **modules})
    monkeypatch.setenv("KNIGHTCUBE_CODE", "before")


def test_a_worker_unpacks_the_packages_and_forgets_earlier_ones(tmp_path: Path, interpreter: None) -> None:
    plugin = ShippedCode(archive_of(tree(tmp_path / "root")))
    worker = SimpleNamespace(local_directory=str(tmp_path / "worker"))
    (tmp_path / "worker").mkdir()
    plugin.setup(worker)
    folder = tmp_path / "worker" / f"knightcube-code-{plugin.version}"
    assert (folder / "flight" / "b.py").read_text() == "flight/b.py"
    assert sys.path == [str(folder), "/usr/lib"]
    assert "flight" not in sys.modules
    assert "flight.link" not in sys.modules
    assert "flightless" in sys.modules
    assert os.environ["KNIGHTCUBE_CODE"] == plugin.version
    assert len(plugin.version) == 16
    # The second worker process of the machine finds the folder.
    (folder / "flight" / "b.py").write_text("kept")
    plugin.setup(worker)
    assert (folder / "flight" / "b.py").read_text() == "kept"
    assert [path.name for path in (tmp_path / "worker").iterdir()] == [folder.name]
    plugin.teardown(worker)


def test_a_worker_that_unpacks_second_removes_its_copy(
    tmp_path: Path, interpreter: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugin = ShippedCode(archive_of(tree(tmp_path / "root")))
    folder = tmp_path / f"knightcube-code-{plugin.version}"

    def taken(self: Path, target: Path) -> None:
        folder.mkdir()
        raise FileExistsError(target)

    monkeypatch.setattr(Path, "rename", taken)
    plugin.setup(SimpleNamespace(local_directory=str(tmp_path)))
    assert [path.name for path in tmp_path.glob("knightcube-code*")] == [folder.name]
    assert sys.path[0] == str(folder)


class KilledWorker(Exception):
    """Error that Dask raises for a case that has ended several workers."""

    last_worker = "tcp://worker-3"


class Client:
    """Client of a scheduler whose futures are given results or exceptions."""

    def __init__(self, answers: dict[str, Any], workers: int = 2) -> None:
        self.answers, self.workers = answers, workers
        self.dashboard_link = "http://dashboard"
        self.submitted: list[tuple[Any, ...]] = []
        self.plugins: list[tuple[Any, str]] = []
        self.pure: set[bool] = set()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *error: object) -> None: ...

    def register_plugin(self, plugin: Any, name: str) -> None:
        self.plugins.append((plugin, name))

    def scheduler_info(self, n_workers: int) -> dict[str, Any]:
        assert n_workers == -1, "all workers, not only the first five"
        return {"workers": dict.fromkeys(range(self.workers))}

    def submit(self, function: Any, *words: Any, pure: bool) -> Any:
        self.pure.add(pure)
        self.submitted.append(words)
        answer = self.answers[words[-1]["key"]]

        def result() -> Any:
            if isinstance(answer, Exception):
                raise answer
            return answer

        return Mock(result=result)


class CommClosedError(Exception):
    """Error of Dask for a lost connection."""


@pytest.fixture
def dask(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Replace Dask's modules. Return the modules that are currently pickled by value."""
    by_value: list[Any] = []
    comm = SimpleNamespace(CommClosedError=CommClosedError)
    distributed = SimpleNamespace(
        WorkerPlugin=type("WorkerPlugin", (), {}),
        as_completed=lambda futures: reversed(list(futures)),
        comm=comm,
        KilledWorker=KilledWorker,
    )
    cloudpickle = SimpleNamespace(
        register_pickle_by_value=by_value.append, unregister_pickle_by_value=by_value.remove
    )
    monkeypatch.setitem(sys.modules, "distributed", distributed)
    monkeypatch.setitem(sys.modules, "cloudpickle", cloudpickle)
    monkeypatch.setattr(cluster, "archive_of", lambda root: b"packages")
    return by_value


def run(case: Case) -> Any:
    return case


CASES = [Case("a", (1, 2), {"x": 1}), Case("b", (3,), {"x": 2})]


def test_each_result_is_yielded_with_its_key_as_soon_as_it_is_known(
    dask: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Client({"a": {"value": 1}, "b": {"value": 2}}, workers=7)
    monkeypatch.setattr(cluster, "_client", lambda address: client)
    told: list[str] = []
    results = finished("tcp://here", run, CASES, told.append)
    assert next(results) == ("b", {"value": 2})
    assert dask == [cluster]
    assert list(results) == [("a", {"value": 1})]
    assert dask == []
    assert told == ["cluster at tcp://here, workers: 7, dashboard: http://dashboard"]
    ((plugin, name),) = client.plugins
    assert name == "knightcube-code"
    assert plugin.version == ShippedCode(b"packages").version
    assert client.pure == {False}
    assert client.submitted == [
        (plugin.version, __name__, "run", {"key": "a", "seed": (1, 2), "parameters": {"x": 1}}),
        (plugin.version, __name__, "run", {"key": "b", "seed": (3,), "parameters": {"x": 2}}),
    ]


@pytest.mark.parametrize(
    ("answer", "error", "text"),
    [
        (CancelledError(), CampaignError, "the scheduler at tcp://here is lost"),
        (CommClosedError(), CampaignError, "the scheduler at tcp://here is lost"),
        (
            KilledWorker(),
            CampaignError,
            "case b: every worker that ran it died, such as tcp://worker-3: check its memory",
        ),
        (None, CampaignError, "other packages were sent to the cluster at tcp://here: only one checkout"),
        (ValueError("wrong"), ValueError, "wrong"),
    ],
)
def test_a_case_without_a_result_ends_the_campaign(
    answer: Any, error: type[Exception], text: str, dask: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_client", lambda address: Client({"a": {}, "b": answer}))
    with pytest.raises(error, match=text):
        list(finished("tcp://here", run, CASES, lambda _: None))
    assert dask == []


@pytest.mark.parametrize("late", [False, True])
def test_a_scheduler_without_workers_is_refused(
    late: bool, dask: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[bool] = []

    def wait(count: int, timeout: float) -> None:
        assert (count, timeout) == (1, cluster.CONNECT_S)
        if late:
            raise TimeoutError

    client = SimpleNamespace(wait_for_workers=wait, close=lambda: closed.append(True))
    monkeypatch.setattr(sys.modules["distributed"], "Client", lambda address, timeout: client, raising=False)
    if late:
        with pytest.raises(UsageError, match="--dask tcp://here: the scheduler has no worker: start `dask"):
            cluster._client("tcp://here")
        assert closed == [True]
    else:
        assert cluster._client("tcp://here") is client
        assert not closed


def test_a_wrong_address_of_the_scheduler_is_refused(
    dask: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def client(address: str, timeout: float) -> None:
        raise OSError("first line\nsecond line")

    monkeypatch.setattr(sys.modules["distributed"], "Client", client, raising=False)
    with pytest.raises(UsageError, match=r"--dask tcp://here: no scheduler answers there \(first line\)"):
        cluster._client("tcp://here")
