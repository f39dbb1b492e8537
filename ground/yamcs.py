"""Writer of a Yamcs 5.12 configuration, started by `python -m ground.yamcs FOLDER [--epoch UTC]`.

Yamcs connects to `knightcube gateway`, which holds the keys and exchanges unprotected packets with Yamcs
(`ground.link.gateway`). Yamcs and the gateway listen on the loopback interface only. Yamcs's own data links
cannot send the gateway's token when they connect. The folder therefore contains `GatewayLink.java`, the
source of a data link that sends the token. This source must be compiled once. Packets are archived by mission
time and sequence count. A command is verified by `verification` packets that contain the packet identifier
and the sequence count of the command. Files are transferred by Yamcs's own CFDP service.

Yamcs requires a password, because otherwise any web page in a browser on the same machine could send requests
to Yamcs.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import secrets
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from flight.link.files.transfer import FOREIGN, SATELLITE
from flight.link.files.units import DOWN, PACKET_VERSION, SEGMENT_BYTES, UNIT_OVERHEAD_BYTES, UP
from flight.link.process.station import host_port
from flight.link.telemetry.packets import HEADER_BYTES, SECONDARY_BYTES
from ground.console.description import layouts_for
from ground.link.gateway import ADDRESS, token_path
from ground.link.terminal import DEFAULTS, FRAME_OVERHEAD_BYTES
from ground.xtce import EPOCH, SPACE, TELECOMMANDS, document
from ground.yamcs_operations import DISPLAYS, STACKS, stacks_and_displays
from knightcube.errors import FlightError, UsageError

if TYPE_CHECKING:
    from ground.console.description import Body

INSTANCE = SPACE.lower()
HTTP_PORT = 8090
KEYS = Path("keys/ground")
CFDP, DOWN_BUCKET, UP_BUCKET = "files", "down", "up"
"""Names of Yamcs's file transfer service, and of the buckets of received files and of files to send."""
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
cacheDir: {data}/cache
secretKey: {secret}
"""

_SECURITY = """\
enabled: true
authModules: [{class: org.yamcs.security.YamlAuthModule}]
"""
USERS, USER = "etc/users.yaml", "admin"
"""Password file, and user name. Without the file, Yamcs accepts a publicly known default password."""

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
    incomingDir: {folder}/{recorded}
    deleteAfterImport: true
    packetInputStreamClassName: org.yamcs.tctm.CcsdsPacketInputStream
    packetInputStreamArgs: {{maxPacketLength: 65542}}
    packetPreprocessorClassName: org.yamcs.tctm.GenericPacketPreprocessor
    packetPreprocessorArgs: *packets
mdb:
  - type: xtce
    args: {{file: {folder}/{instance}.xml}}
streamConfig:
  tm: [{{name: tm_realtime, processor: realtime}}]
  invalidTm: invalid_tm_stream
  cmdHist: [cmdhist_realtime, cmdhist_dump]
  event: [events_realtime, events_dump]
  param: [pp_realtime, sys_param, proc_param]
  parameterAlarm: [alarms_realtime]
  eventAlarm: [event_alarms_realtime]
  tc: [{{name: tc_realtime, processor: realtime}}]
  sqlFile: {folder}/etc/files.sql
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
        data=folder / "data",
        folder=folder,
        secret=secrets.token_hex(_SECRET_BYTES),
        buckets=", ".join(f"{{name: {name}, path: {folder}/{name}}}" for name in _BUCKETS),
    )
    instance = _INSTANCE.format(
        live=str(gateway is not None).lower(),
        recorded=RECORDED,
        gateway_host=host,
        gateway_port=port,
        token=token_path(keys.absolute(), port),
        folder=folder,
        instance=INSTANCE,
        epoch=epoch,
        cfdp=CFDP,
        pdu_bytes=min(SEGMENT_BYTES, command_frame_bytes - FRAME_OVERHEAD_BYTES - UNIT_OVERHEAD_BYTES),
        own=FOREIGN,
        satellite=SATELLITE,
        down=DOWN_BUCKET,
    )
    before = HEADER_BYTES + SECONDARY_BYTES
    header = f"{UP:04X}C0000000{PACKET_VERSION:02X}" + "00" * (SECONDARY_BYTES - 1)
    return {
        "etc/yamcs.yaml": server,
        "etc/security.yaml": _SECURITY,
        USERS: f'{USER}: {{password: "{secrets.token_hex(_SECRET_BYTES)}", superuser: true}}\n',
        "etc/files.sql": _STREAMS.format(before=before, down=DOWN, space=SPACE, header=header),
        f"etc/yamcs.{INSTANCE}.yaml": instance,
        "etc/processor.yaml": _PROCESSORS,
        f"{INSTANCE}.xml": document(commands=layouts_for(body, TELECOMMANDS), epoch=epoch, verified=True),
        **stacks_and_displays(body),
    }


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
        raise UsageError(f"{folder}: cannot be written: {error.strerror or error}") from error


def password_in(folder: Path) -> str:
    """Return the password in the configuration in a folder."""
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

    Raises UsageError if the folder cannot be written, and FlightError with the compiler's text.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LINK_SOURCE).write_text(_LINK, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written: {error.strerror or error}") from error
    compiler = ["java", *_FRUGAL, "-cp", class_path()]
    compiler += ["-m", "jdk.compiler/com.sun.tools.javac.Main", "-proc:none"]
    command = [*compiler, "-d", str(folder), str(folder / LINK_SOURCE)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise FlightError(f"the data link cannot be compiled:\n{done.stdout}{done.stderr}")


def command_line(folder: Path) -> list[str]:
    """Return the command that starts Yamcs with the configuration in a folder."""
    places = ["--etc-dir", str(folder / "etc"), "--data-dir", str(folder / "data")]
    flags = ["-Djava.awt.headless=true", "-Djava.net.preferIPv4Stack=true", *_FRUGAL]
    java = ["java", *flags, "-cp", f"{class_path()}:{folder}"]
    return [*java, "org.yamcs.YamcsServer", *places, "--no-color"]


def main() -> None:
    """Write the configuration that the command line `words` describes."""
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
    write(
        options.folder,
        options.gateway,
        options.http,
        options.epoch,
        options.keys,
        options.command_frame_bytes,
    )
    sys.stdout.write(f"Yamcs asks for user and password: {USER}, and the one in {options.folder / USERS}\n")


if __name__ == "__main__":
    main()
