"""Actions of an operator, by the Python client of Yamcs (`yamcs-client`)."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from datetime import datetime

from yamcs.client import Alarm, BasicAuthCredentials, YamcsClient
from yamcs.client.activities import StackActivity
from yamcs.protobuf.activities import activities_pb2

from ground.xtce import SPACE
from ground.yamcs import CFDP, DOWN_BUCKET, INSTANCE, PASS, STACKS, UP_BUCKET, USER

_LONGEST_S = 120.0
_ENDED = {"SUCCESSFUL", "FAILED", "CANCELLED"}


class Operator:
    """A connection to Yamcs, with the actions of an operator."""

    def __init__(self, port: int, password: str) -> None:
        """Connect to Yamcs on a port of loopback."""
        self._client = YamcsClient(f"127.0.0.1:{port}", credentials=BasicAuthCredentials(USER, password))
        self._processor = self._client.get_processor(INSTANCE, "realtime")
        self._files = self._client.get_file_transfer_client(INSTANCE).get_service(CFDP)

    def wait_for(self, parameter: str, wanted: str) -> None:
        """Wait until a parameter has a given value."""
        name = f"/{SPACE}/{parameter}"

        def value() -> object:
            found = self._processor.get_parameter_value(name)
            return None if found is None else found.eng_value

        _until(lambda: value() == wanted)

    def archived(self, packet: str, number: int) -> int:
        """Wait until the archive has `number` packets of a type, or until a timeout; return their number."""
        archive, counts = self._client.get_archive(INSTANCE), [0]

        def complete() -> bool:
            counts.append(len(list(archive.list_packets(name=f"/{SPACE}/{packet}"))))
            return counts[-1] == number

        with contextlib.suppress(AssertionError):  # the caller checks the number
            _until(complete)
        return counts[-1]

    def run_stack(self, name: str) -> str:
        """Run a command stack and return its final state."""
        definition = StackActivity(STACKS, f"{name}.ycs")._to_proto()
        path = f"/activities/{INSTANCE}/activities"
        found = activities_pb2.ActivityInfo()
        found.ParseFromString(self._client.ctx.post_proto(path, data=definition.SerializeToString()).content)

        def status() -> str:
            found.ParseFromString(self._client.ctx.get_proto(f"{path}/{found.id}").content)
            return str(activities_pb2.ActivityStatus.Name(found.status))

        _until(lambda: status() in _ENDED)
        return status()

    def raised_and_acknowledged(self, parameter: str) -> tuple[str, bool, str | None]:
        """Wait for a parameter's alarm, and acknowledge it; return its severity, state and message."""
        name = f"/{SPACE}/{parameter}"

        def alarms() -> list[Alarm]:
            return [alarm for alarm in self._processor.list_alarms() if alarm.name == name]

        _until(lambda: bool(alarms()))
        self._processor.acknowledge_alarm(name, alarms()[0].sequence_number, "seen")
        _until(lambda: alarms()[0].is_acknowledged)
        (alarm,) = alarms()
        return alarm.severity, alarm.is_acknowledged, alarm.acknowledge_message

    def sent(self) -> list[str]:
        """Return the names of the sent commands, oldest first."""
        history = self._client.get_archive(INSTANCE).list_command_history()
        return [entry.name.rpartition("/")[2] for entry in history]

    def downloaded(self, name: str) -> bytes:
        """Command the download of a file from the satellite, and return its content."""
        arguments = {"entity": "another-ground-station", "name": name}
        transfers = self._files.create_transfer_subscription()
        self._processor.issue_command(f"/{SPACE}/send-file", args=arguments)
        _until(lambda: bool(transfers.list_completed()))
        transfers.cancel()
        bucket = self._client.get_storage_client().get_bucket(DOWN_BUCKET)
        _until(lambda: bool(list(bucket.list_objects().objects)))
        (stored,) = bucket.list_objects().objects
        return bytes(stored.download())

    def upload(self, content: bytes, remote: str) -> None:
        """Upload a file to the satellite, and wait for the end of the transfer."""
        bucket = self._client.get_storage_client().get_bucket(UP_BUCKET)
        bucket.upload_object("file", content)
        way = {"source_entity": "ground", "destination_entity": "satellite", "options": {"reliable": True}}
        transfer = self._files.upload(UP_BUCKET, "file", remote, **way)
        transfer.await_complete(_LONGEST_S)
        assert transfer.is_success(), transfer.error

    def passes(self) -> list[tuple[datetime, float]]:
        """Return the start and duration (s) of each pass on the timeline."""
        items = self._client.get_timeline_client(INSTANCE).list_items()
        found = [(item.start, item.duration.total_seconds()) for item in items if PASS in item.tags]
        return sorted(found)


def _until(done: Callable[[], bool]) -> None:
    until = time.monotonic() + _LONGEST_S
    while not done():
        assert time.monotonic() < until
        time.sleep(0.2)
