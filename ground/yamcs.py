"""Writer of a Yamcs 5.12 configuration, started by `python -m ground.yamcs FOLDER [--epoch UTC]`.

Yamcs connects to `knightcube gateway`, which has the keys and exchanges unprotected packets with Yamcs
(`ground.link.gateway`). Yamcs and the gateway listen on the loopback interface only. Yamcs's own data links
cannot send the gateway's token when they connect. The configuration folder therefore contains
`GatewayLink.java`, the source of a data link that sends the token. The Java source must be compiled once.
Packets are archived by mission time and sequence count. A command is verified by `verification` packets that
contain the packet identifier and the sequence count of the command. Files are transferred by Yamcs's own CFDP
service.

Yamcs requires a password, because otherwise any web page in a browser on the same machine could send requests
to Yamcs.
"""

from __future__ import annotations

import argparse
import base64
import importlib.util
import json
import re
import secrets
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from flight.link.commands import Point, words_of
from flight.link.files.transfer import FOREIGN, SATELLITE
from flight.link.files.units import DOWN, PACKET_VERSION, SEGMENT_BYTES, UNIT_OVERHEAD_BYTES, UP
from flight.link.process.station import host_port
from flight.link.telemetry.packets import HEADER_BYTES, LAYOUTS, SECONDARY_BYTES
from ground.documentation import foreign_modes, layouts_for
from ground.link.gateway import ADDRESS, token_path
from ground.link.terminal import DEFAULTS, FRAME_OVERHEAD_BYTES
from ground.xtce import EPOCH, SPACE, TELECOMMANDS, UNUSED, document, epoch_of, spread
from knightcube.errors import KnightCubeError, UsageError, reason_of
from knightcube.gnc.guidance.pointing_target import PointingTarget

if TYPE_CHECKING:
    from ground.documentation import Body
    from ground.passes import OrbitPrediction, Pass, Station

INSTANCE = SPACE.lower()
HTTP_PORT = 8090
KEYS = Path("keys/ground")
CFDP, DOWN_BUCKET, UP_BUCKET = "files", "down", "up"
"""Names of Yamcs's file transfer service, and of the buckets of received files and of files to send."""
STACKS, DISPLAYS = "stacks", "displays"
"""Names of the buckets in which Yamcs's page looks for command stacks and displays."""
_BUCKETS = (DOWN_BUCKET, UP_BUCKET, STACKS, DISPLAYS)
RECORDED = "recorded"
"""Name of the data link that reads and deletes packet files, and of the folder of these files."""
_LOOPBACK = "127.0.0.1"
_SECRET_BYTES = 16

_SERVER = """\
services:
  - class: org.yamcs.http.HttpServer
    args: {{address: {host}, port: {http}}}
instances: [{instance}]
buckets: [{buckets}]
dataDir: {data}
cacheDir: {cache}
secretKey: {secret}
"""

_SECURITY = """\
enabled: true
authModules: [{class: org.yamcs.security.YamlAuthModule}]
"""
USERS, USER = "etc/users.yaml", "admin"
"""File that contains the password of Yamcs, and user name in Yamcs.

Without the file, Yamcs accepts a publicly known default password.
"""

_INSTANCE = """\
services:
  - class: org.yamcs.archive.XtceTmRecorder
  - class: org.yamcs.archive.ParameterRecorder
  - class: org.yamcs.archive.AlarmRecorder
  - class: org.yamcs.archive.EventRecorder
  - class: org.yamcs.archive.ReplayServer
  - class: org.yamcs.archive.CommandHistoryRecorder
  - class: org.yamcs.parameterarchive.ParameterArchive
  - class: org.yamcs.ProcessorCreatorService
    args: {{name: realtime, type: realtime}}
  - class: org.yamcs.timeline.TimelineService
  - class: org.yamcs.cfdp.CfdpService
    name: {cfdp}
    args:
      entityIdLength: 2
      sequenceNrLength: 4
      maxPduSize: {pdu_bytes}
      sleepBetweenPdus: 20
      inactivityTimeout: 60000
      eofAckLimit: 720
      finAckLimit: 720
      immediateNak: false
      nakTimeout: 2000
      incomingBucket: {down}
      allowDownloadOverwrites: true
      localEntities: [{{name: ground, id: {own}, bucket: {down}}}]
      remoteEntities: [{{name: satellite, id: {satellite}}}]
dataLinks:
  - name: gateway
    class: GatewayLink
    enabledAtStartup: {live}
    tokenFile: {token}
    tmStream: tm_realtime
    tcStream: tc_realtime
    host: {gateway_host}
    port: {gateway_port}
    packetInputStreamClassName: org.yamcs.tctm.CcsdsPacketInputStream
    packetInputStreamArgs: {{maxPacketLength: 65542}}
    packetPreprocessorClassName: org.yamcs.tctm.GenericPacketPreprocessor
    packetPreprocessorArgs: &packets
      timestampOffset: 7
      seqCountOffset: 2
      errorDetection: {{type: CRC-16-CCIIT}}
      timeEncoding:
        {{type: FIXED, size: 8, multiplier: 1.0e-6, epoch: CUSTOM, epochUTC: "{epoch}Z"}}
    commandPostprocessorClassName: org.yamcs.pus.PusCommandPostprocessor
    commandPostprocessorArgs: {{pus11Crc: false}}
  - name: {recorded}
    class: org.yamcs.tctm.FilePollingTmDataLink
    stream: tm_realtime
    incomingDir: {incoming}
    deleteAfterImport: true
    packetInputStreamClassName: org.yamcs.tctm.CcsdsPacketInputStream
    packetInputStreamArgs: {{maxPacketLength: 65542}}
    packetPreprocessorClassName: org.yamcs.tctm.GenericPacketPreprocessor
    packetPreprocessorArgs: *packets
mdb:
  - type: xtce
    args: {{file: {database}}}
streamConfig:
  tm: [{{name: tm_realtime, processor: realtime}}]
  invalidTm: invalid_tm_stream
  cmdHist: [cmdhist_realtime, cmdhist_dump]
  event: [events_realtime, events_dump]
  param: [pp_realtime, sys_param, proc_param]
  parameterAlarm: [alarms_realtime]
  eventAlarm: [event_alarms_realtime]
  tc: [{{name: tc_realtime, processor: realtime}}]
  sqlFile: {sql}
"""

LINK_SOURCE = "GatewayLink.java"
_LINK = """\
import java.io.IOException;
import java.nio.file.Files;
import java.nio.file.Path;
import org.yamcs.Spec;
import org.yamcs.YConfiguration;
import org.yamcs.tctm.TcpTcTmDataLink;

/** Sends the token of `knightcube gateway` at the beginning of each connection. */
public class GatewayLink extends TcpTcTmDataLink {
    private Path tokenFile;

    @Override
    public Spec getSpec() {
        Spec spec = super.getSpec();
        spec.addOption("tokenFile", Spec.OptionType.STRING).withRequired(true);
        return spec;
    }

    @Override
    public void init(String instance, String name, YConfiguration config) {
        tokenFile = Path.of(config.getString("tokenFile"));
        super.init(instance, name, config);
    }

    @Override
    protected synchronized void checkAndOpenSocket() throws IOException {
        if (!isSocketOpen()) {
            byte[] token = Files.readAllBytes(tokenFile); // of this start of the gateway
            super.checkAndOpenSocket();
            sendBuffer(token);
        }
    }
}
"""

_HEADERS = HEADER_BYTES + SECONDARY_BYTES  # length of both headers of a packet, bytes
_STREAMS = """\
create stream cfdp_in as select substring(packet, {before}) as pdu from tm_realtime \
where extract_short(packet, 0) = {down}
create stream cfdp_out (gentime TIMESTAMP, entityId long, seqNum int, pdu binary)
insert into tc_realtime select gentime, 'cfdp-service' as origin, seqNum, '/{space}/file-unit' as cmdName, \
unhex('{header}') + pdu + unhex('0000') as binary from cfdp_out
"""

_PROCESSORS = """\
realtime:
  services:
    - class: org.yamcs.StreamTmPacketProvider
    - class: org.yamcs.StreamTcCommandReleaser
    - class: org.yamcs.tctm.StreamParameterProvider
    - class: org.yamcs.algorithms.AlgorithmManager
    - class: org.yamcs.parameter.LocalParameterManager
  config:
    subscribeAll: true
    alarm: {parameterCheck: true, parameterServer: enabled, eventServer: enabled}
Archive: &replay
  services:
    - class: org.yamcs.tctm.ReplayService
    - class: org.yamcs.algorithms.AlgorithmManager
ParameterArchive: *replay
ArchiveRetrieval: *replay
"""


def files(
    folder: Path,
    gateway: str | None,
    http_port: int,
    epoch: str,
    keys: Path = KEYS,
    command_frame_bytes: int = DEFAULTS.command_frame_bytes,
    body: Body | None = None,
) -> Mapping[str, str]:
    """Return the content of each configuration file by its name below `folder`.

    If `gateway` is None, Yamcs reads only recorded packets. The folder `keys` contains the gateway's keys.
    """
    host, port = host_port(gateway or ADDRESS)
    server = _SERVER.format(
        host=_LOOPBACK,
        http=http_port,
        instance=INSTANCE,
        data=_quoted(folder / "data"),
        cache=_quoted(folder / "data/cache"),
        secret=secrets.token_hex(_SECRET_BYTES),
        buckets=", ".join(f"{{name: {name}, path: {_quoted(folder / name)}}}" for name in _BUCKETS),
    )
    instance = _INSTANCE.format(
        live=str(gateway is not None).lower(),
        recorded=RECORDED,
        gateway_host=host,
        gateway_port=port,
        token=_quoted(token_path(keys.absolute(), port)),
        incoming=_quoted(folder / RECORDED),
        database=_quoted(folder / f"{INSTANCE}.xml"),
        sql=_quoted(folder / "etc/files.sql"),
        epoch=epoch,
        cfdp=CFDP,
        pdu_bytes=min(SEGMENT_BYTES, command_frame_bytes - FRAME_OVERHEAD_BYTES - UNIT_OVERHEAD_BYTES),
        own=FOREIGN,
        satellite=SATELLITE,
        down=DOWN_BUCKET,
    )
    header = f"{UP:04X}C0000000{PACKET_VERSION:02X}" + "00" * (SECONDARY_BYTES - 1)
    return {
        "etc/yamcs.yaml": server,
        "etc/security.yaml": _SECURITY,
        USERS: f'{USER}: {{password: "{secrets.token_hex(_SECRET_BYTES)}", superuser: true}}\n',
        "etc/files.sql": _STREAMS.format(before=_HEADERS, down=DOWN, space=SPACE, header=header),
        f"etc/yamcs.{INSTANCE}.yaml": instance,
        "etc/processor.yaml": _PROCESSORS,
        f"{INSTANCE}.xml": document(commands=layouts_for(body, TELECOMMANDS), epoch=epoch, verified=True),
        **stacks_and_displays(body),
    }


def _quoted(path: Path) -> str:
    """Return a path as a YAML string in double quotes, because a path may contain `: `, ` #` or braces."""
    return json.dumps(str(path), ensure_ascii=False)


def write(
    folder: Path,
    gateway: str | None = ADDRESS,
    http_port: int = HTTP_PORT,
    epoch: str = EPOCH,
    keys: Path = KEYS,
    command_frame_bytes: int = DEFAULTS.command_frame_bytes,
    body: Body | None = None,
) -> None:
    """Write the configuration into a folder. Raises UsageError."""
    folder = folder.absolute()
    try:
        contents = files(folder, gateway, http_port, epoch, keys, command_frame_bytes, body)
    except ValueError as error:
        raise UsageError(f"{gateway}: give HOST:PORT of the gateway") from error
    try:
        for name, text in contents.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch(mode=0o600)
            path.chmod(0o600)
            path.write_text(text, encoding="utf-8")
        for name in ("data", RECORDED, *_BUCKETS):
            (folder / name).mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written: {reason_of(error)}") from error


def password_in(folder: Path) -> str:
    """Return the password of the Yamcs configuration in `folder`."""
    found = re.search(r'password: "(\w+)"', (folder / USERS).read_text(encoding="utf-8"))
    assert found is not None
    return found[1]


_BUNDLE = "fprime_yamcs_bundle"
_FRUGAL = ("-XX:TieredStopAtLevel=1", "-XX:+UseSerialGC")
"""Java options for a small server: only the fast compiler, and garbage collection in one thread."""


def missing() -> str:
    """Return a text about missing software that Yamcs needs, or an empty text."""
    if shutil.which("java") is None:
        return "Java is missing: apt-get install default-jre-headless"
    if importlib.util.find_spec(_BUNDLE) is None:
        return "Yamcs is missing: pip install 'knightcube-flight[interop]'"
    return ""


def class_path() -> str:
    """Return the Java class path of the archives in the Yamcs bundle."""
    found = importlib.util.find_spec(_BUNDLE)
    assert found is not None
    assert found.submodule_search_locations
    return str(Path(found.submodule_search_locations[0]) / "lib" / "*")


def compile_link(folder: Path) -> None:
    """Write the source of the data link into a folder and compile it.

    Raises UsageError if the folder cannot be written, and KnightCubeError with the compiler's messages if the
    compilation fails.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LINK_SOURCE).write_text(_LINK, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written: {reason_of(error)}") from error
    compiler = ["java", *_FRUGAL, "-cp", class_path()]
    compiler += ["-m", "jdk.compiler/com.sun.tools.javac.Main", "-proc:none"]
    command = [*compiler, "-d", str(folder), str(folder / LINK_SOURCE)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise KnightCubeError(f"the data link cannot be compiled:\n{done.stdout}{done.stderr}")


def command_line(folder: Path) -> list[str]:
    """Return the command that starts Yamcs with the configuration in a folder."""
    places = ["--etc-dir", str(folder / "etc"), "--data-dir", str(folder / "data")]
    flags = ["-Djava.awt.headless=true", "-Djava.net.preferIPv4Stack=true", *_FRUGAL]
    java = ["java", *flags, "-cp", f"{class_path()}:{folder}"]
    return [*java, "org.yamcs.YamcsServer", *places, "--no-color"]


def main() -> None:
    """Write the configuration that the command line describes."""
    parser = argparse.ArgumentParser(prog="python -m ground.yamcs", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of the configuration and the archive")
    parser.add_argument("--gateway", default=ADDRESS, metavar="HOST:PORT", help=f"default {ADDRESS}")
    text = f"folder of the gateway's keys, for its token (default {KEYS})"
    parser.add_argument("--keys", type=Path, default=KEYS, metavar="FOLDER", help=text)
    parser.add_argument("--http", type=int, default=HTTP_PORT, metavar="PORT", help=f"default {HTTP_PORT}")
    parser.add_argument("--epoch", default=EPOCH, metavar="UTC", help=f"mission time zero (default {EPOCH})")
    text = "`link.command_frame_bytes` of the satellite (default %(default)s)"
    size = DEFAULTS.command_frame_bytes
    parser.add_argument("--command-frame-bytes", type=int, default=size, metavar="N", help=text)
    options = parser.parse_args()
    frame_bytes = options.command_frame_bytes
    try:
        epoch = epoch_of(options.epoch)
        write(options.folder, options.gateway, options.http, epoch, options.keys, frame_bytes)
    except KnightCubeError as error:
        parser.error(str(error))
    sys.stdout.write(f"Yamcs asks for user {USER} and the password in {options.folder / USERS}\n")


PASS = "pass"
"""Tag that marks a timeline item as a pass."""
_VERIFY_MS = 10_000
"""Longest time (ms) to wait until a condition is satisfied; the packet `health` arrives every second."""
_SCHEMA = "https://yamcs.org/schema"
_REQUEST_S = 300.0
_PAGE = 500  # maximum number of timeline items in one answer


def _command(name: str, **arguments: object) -> dict[str, Any]:
    listed = [{"name": key, "value": value} for key, value in arguments.items()]
    return {"type": "command", "name": f"/{SPACE}/{name}", "arguments": listed}


def _mode(operator: str, mode: str) -> dict[str, Any]:
    """Return the condition that the satellite's mode equals ("eq") or differs from ("neq") `mode`."""
    condition = {"parameter": f"/{SPACE}/health_mode", "operator": operator, "value": mode}
    return {"type": "verify", "condition": [condition], "delay": 0, "timeout": _VERIFY_MS}


_PROCEDURES: Mapping[str, Sequence[dict[str, Any]]] = {
    "check-health": (
        _command("ping", number=1),
        _mode("neq", "safe"),
        _command("dump-parameters"),
        _command("list-schedule"),
    ),
    "enter-safe": (_command("safe", reason="command stack"), _mode("eq", "safe")),
    "leave-safe-to-hold": (_mode("eq", "safe"), _command("mode", mode="hold"), _mode("eq", "hold")),
    "leave-safe-to-point": (_mode("eq", "safe"), _command("mode", mode="point"), _mode("neq", "safe")),
    "slew-to-zero": (_mode("neq", "safe"), _command("slew", q2=0.0), _mode("eq", "hold")),
    "detumble": (_mode("neq", "safe"), _command("mode", mode="detumble"), _mode("neq", "safe")),
    "list-files": (_command("list-files", entity="another-ground-station", under=""),),
}
"""Steps of each procedure by its name. On the way to mode `point`, a satellite may be in mode `acquire`."""


def procedures_of(body: Body | None) -> Mapping[str, Sequence[dict[str, Any]]]:
    """Return the steps of each procedure for a kind of body; all procedures if the body is not known."""
    known = {f"/{SPACE}/{name}" for name in layouts_for(body, TELECOMMANDS)}
    foreign = {mode.label for mode in foreign_modes(body)}

    def obeyed(step: dict[str, Any]) -> bool:
        values = {one["value"] for one in (*step.get("arguments", ()), *step.get("condition", ()))}
        return step.get("name", min(known)) in known and not values & foreign

    return {name: steps for name, steps in _PROCEDURES.items() if all(map(obeyed, steps))}


def stacks_and_displays(body: Body | None = None) -> Mapping[str, str]:
    """Return the content of each command stack and display by its name, for a kind of body."""
    found: dict[str, str] = {}
    advancement = {"acknowledgment": "CommandComplete", "wait": 0}
    for name, steps in procedures_of(body).items():
        schema = f"{_SCHEMA}/command-stack.schema.json"
        stack = {"$schema": schema, "steps": steps, "advancement": advancement}
        found[f"{STACKS}/{name}.ycs"] = json.dumps(stack, indent=2) + "\n"
    shown = [f"/{SPACE}/{name}" for name, _ in spread(LAYOUTS["health"]) if not name.endswith(UNUSED)]
    display = {"$schema": f"{_SCHEMA}/parameter-table.schema.json", "scroll": False, "parameters": shown}
    found[f"{DISPLAYS}/health.par"] = json.dumps(display, indent=2) + "\n"
    return found


@dataclass(frozen=True, slots=True)
class Session:
    """Access to the HTTP interface of a running Yamcs, such as `http://127.0.0.1:8090/api`."""

    url: str
    user: str
    password: str

    def ask(self, path: str, body: Mapping[str, Any] | None = None, method: str | None = None) -> Any:
        """Return the answer to GET, to POST of a body, or to another method. Raises OSError."""
        data = None if body is None else json.dumps(body).encode()
        secret = base64.b64encode(f"{self.user}:{self.password}".encode()).decode()
        headers = {"Content-Type": "application/json", "Authorization": f"Basic {secret}"}
        request = urllib.request.Request(self.url + path, data, headers, method=method)
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=_REQUEST_S) as answer:
            return json.loads(answer.read())


def add_passes(
    session: Session, instance: str, prediction: OrbitPrediction, stations: Sequence[Station]
) -> None:
    """Show the predicted passes on the timeline, and delete earlier predictions of the same span.

    A view of the timeline is added at the first call. Raises OSError if Yamcs refuses a request.
    """
    from ground.passes import scheduled_targets  # noqa: PLC0415 - Skyfield is large

    timeline = f"/timeline/{instance}"
    if not session.ask(f"{timeline}/views").get("views"):
        common = {"shared": True, "source": "rdb"}
        ruler = {**common, "name": "UTC", "type": "TIME_RULER", "properties": {"timezone": "UTC"}}
        band = {**common, "name": "passes", "type": "ITEM_BAND", "tags": [PASS]}
        bands = [session.ask(f"{timeline}/bands", one)["id"] for one in (ruler, band)]
        session.ask(f"{timeline}/views", {"name": "passes", "bands": bands})
    for old in list(_shown(session, timeline, prediction)):
        session.ask(f"{timeline}/items/{old}", method="DELETE")
    found = prediction.passes(stations)
    for one, schedule in zip(found, scheduled_targets(found), strict=True):
        session.ask(f"{timeline}/items", _item(one, schedule))


def _shown(session: Session, timeline: str, prediction: OrbitPrediction) -> Iterator[str]:
    """Yield the identifiers of the passes on the timeline in the span of a prediction."""
    query = {"start": prediction.begin.isoformat(), "stop": prediction.end.isoformat(), "limit": str(_PAGE)}
    while True:
        found = session.ask(f"{timeline}/items?{urlencode(query)}")
        yield from (item["id"] for item in found.get("items", ()) if PASS in item.get("tags", ()))
        if "continuationToken" not in found:
            return
        query["next"] = found["continuationToken"]


def _item(one: Pass, schedule: list[tuple[datetime, PointingTarget]]) -> dict[str, Any]:
    """Return a pass as a timeline item, with sunlight or shadow, and arguments for the command `schedule`."""
    begin = one.rise.replace(microsecond=0)
    azimuths = " to ".join(f"{azimuth:.0f}" for azimuth in one.azimuths_deg)
    light = "sunlight" if one.sunlit > 0.5 else "shadow"
    words = [f"{at:%Y-%m-%dT%H:%M:%S} {words_of(Point(target))}" for at, target in schedule]
    facts = [
        f"azimuths {azimuths} deg",
        f"satellite in {light}",
        f"Sun {one.sun_elevation_deg:.0f} deg high",
        *(f"schedule {line}" for line in words),
    ]
    return {
        "source": "rdb",
        "type": "EVENT",
        "name": f"{one.station.name}, {one.elevation_deg:.0f} deg",
        "start": begin.isoformat(),
        "duration": f"{(one.set - begin).total_seconds():.0f}s",
        "tags": [PASS],
        "description": "; ".join(facts),
    }


if __name__ == "__main__":
    main()
