"""Server of simulated hardware in real time, in a process that survives the flight process.

The VN-100 is served on a pseudo-terminal. The I2C bus and the cameras answer requests on a Unix socket, whose
client is `sim_hal.rig`. The requests of each connection are answered one after the other. The pixels of a
frame are transferred through a file in the folder of the socket. A separate process renders the frames, so
that rendering does not delay the devices.
"""

from __future__ import annotations

import ctypes
import os
import selectors
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, cast

from flight.link.telemetry.log import FlightLog
from flight.schema.devices import Camera
from flight.schema.sections import Config
from hal.buses.system import SystemClock
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import LATE_NS
from knightcube.astro.arrays import FloatArray, Image
from knightcube.errors import reason_of
from sim_hal.assembly import Hardware, StarRenderer, assemble, fault_generator, render_wide
from sim_hal.emulation import EmulatedWires
from sim_hal.emulators.camera import EmulatedCamera
from sim_hal.emulators.serial_line import PtyLine
from sim_hal.faults.catalogue import Bench
from sim_hal.faults.schedule import parse, put
from sim_hal.serving.device_link import Inbox, pack
from sim_hal.settings import Simulation, SkySection
from sim_hal.worlds.world import TruthRecorder

if TYPE_CHECKING:
    from sim_hal.earth_camera import EarthCameraModel, EarthScene
    from sim_hal.star_camera import SourceTrack

SOCKET_NAME = "devices.sock"
_LONGEST_WAIT_NS = 20_000_000
_FRAME_SLOTS = 4
_PR_SET_PDEATHSIG = 1

_BUS_CALLS = (
    "write_byte",
    "read_byte_data",
    "write_byte_data",
    "read_i2c_block_data",
    "write_i2c_block_data",
)
_renderer: list[StarRenderer] = []


def _prepare_renderer(camera: Camera | None, sky: SkySection, seed: int) -> None:
    """Load the star catalogue once in the rendering process, which ends with the server."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if camera is not None:
        _renderer.append(StarRenderer(camera, sky, seed))


def _render(sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack]) -> Image:
    return _renderer[0].render(sequence, times, attitudes, tracks)


class _DeviceClient:
    """Connection of a flight process to a bus or to a camera."""

    def __init__(self, line: socket.socket) -> None:
        self.line = line
        self.wants_frames: set[int] = set()
        # Name of the selected bus or SPI device, or None for the bus of the coils.
        self.selected: str | None = None
        self._inbox = Inbox()

    def requests(self) -> list[Any] | None:
        """Return the complete requests received, or None after the client has disconnected."""
        try:
            chunk = self.line.recv(65536)
        except ConnectionError:
            return None
        return self._inbox.take(chunk) if chunk else None

    def answer(self, message: Any) -> None:
        """Send a message to the client; a client that has ended or does not read is ignored."""
        try:
            self.line.sendall(pack(message))
        except OSError:
            self.wants_frames.clear()


class DeviceServer:
    """Server of the devices of one configuration."""

    def __init__(self, config: Config, section: Simulation, folder: Path) -> None:
        self._clock = SystemClock()
        self._place = tempfile.TemporaryDirectory(prefix="knightcube-")
        self._stopped = False
        self._log = FlightLog(folder, "truth", clock=self._clock)
        self._pool = _renderer_pool(config, section)
        self._rendering: Future[Image] | None = None
        wires = EmulatedWires(self._clock.now_ns, section.seed, config.coils.bus, pty=True)
        self.hardware: Hardware = assemble(
            config,
            section,
            self._clock.now_ns,
            wires,
            TruthRecorder(self._log),
            self._expose,
            self._expose_wide,
        )
        self._lines = {name: line for name, line in wires.lines.items() if isinstance(line, PtyLine)}
        self.lines = {name: line.name for name, line in self._lines.items()}
        self._faults_drawn = fault_generator(section.seed)
        self._frames_sent = 0
        # Number of delayed device events since the release, and the largest delay (ns).
        self._late = self._latest_ns = 0
        self._served_anybody = False
        self._selector = selectors.DefaultSelector()
        self._connections: dict[int, _DeviceClient] = {}
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.socket_path = Path(self._place.name) / SOCKET_NAME
        self._listener.bind(str(self.socket_path))
        self._listener.listen(8)
        self._selector.register(self._listener, selectors.EVENT_READ)
        for line in self._lines.values():
            self._selector.register(line.fileno(), selectors.EVENT_READ)

    def stop(self, *_: int | FrameType | None) -> None:
        """Stop serving the devices; this method is also a signal handler."""
        self._stopped = True

    def attend(self, descriptor: int, answer: Callable[[], None]) -> None:
        """Call `answer` whenever `descriptor` is readable, after advancing the devices to the present."""
        self._selector.register(descriptor, selectors.EVENT_READ, answer)

    def serve(self, patience_ns: int | None = None) -> None:
        """Advance the devices and answer requests until `stop` is called.

        If `patience_ns` is given, serving also ends when no client has been connected for this time after the
        first client.
        """
        left_ns: int | None = None
        while not self._stopped:
            now_ns = self._clock.now_ns()
            if self._connections or not self._served_anybody:
                left_ns = None
            elif left_ns is None:
                left_ns = now_ns
            elif patience_ns is not None and now_ns - left_ns > patience_ns:
                return
            for pty in self._lines.values():
                pty.exchange(now_ns)
            self._advance(now_ns)
            self._deliver_frames()
            due_ns = min(
                self.hardware.simulation.next_event_ns(),
                *(pty.to_host.next_arrival_ns() for pty in self._lines.values()),
                now_ns + _LONGEST_WAIT_NS,
            )
            for key, _ in self._selector.select(max(0, due_ns - self._clock.now_ns()) * 1e-9):
                if key.fileobj is self._listener:
                    line, _ = self._listener.accept()
                    self._served_anybody = True
                    self._connections[line.fileno()] = _DeviceClient(line)
                    self._selector.register(line, selectors.EVENT_READ)
                elif key.fd in self._connections:
                    self._serve_client(self._connections[key.fd])
                elif key.data is not None:
                    self._advance(self._clock.now_ns())
                    key.data()

    def _advance(self, now_ns: int) -> None:
        """Process the events of the devices up to the present, and count late events."""
        late_ns = now_ns - self.hardware.simulation.next_event_ns()
        self._late += late_ns > LATE_NS
        self._latest_ns = max(self._latest_ns, late_ns)
        self.hardware.simulation.advance_to(now_ns)

    def close(self) -> None:
        """Close all connections, lines and files, and end the rendering process."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
        for connection in self._connections.values():
            connection.line.close()
        self._listener.close()
        self._place.cleanup()
        for pty in self._lines.values():
            pty.close()
        self._log.close()

    def _expose(
        self, sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack]
    ) -> Future[Image]:
        assert self._pool is not None
        # The previous exposure is finished or abandoned; its rendering would delay the new exposure.
        if self._rendering is not None:
            self._rendering.cancel()
        self._rendering = self._pool.submit(_render, sequence, times, attitudes, tracks)
        return self._rendering

    def _expose_wide(
        self, model: EarthCameraModel, scene: EarthScene, seed: tuple[int, ...]
    ) -> Future[Image]:
        assert self._pool is not None
        return self._pool.submit(render_wide, model, scene, seed)

    def _serve_client(self, connection: _DeviceClient) -> None:
        requests = connection.requests()
        if requests is None:
            self._selector.unregister(connection.line)
            del self._connections[connection.line.fileno()]
            connection.line.close()
            return
        for number, name, *arguments in requests:
            self._advance(self._clock.now_ns())
            try:
                result = self._operations()[name](connection, *arguments)
            except OSError as error:
                connection.answer([number, "error", error.errno or 0, str(error.strerror or error)])
            except DeviceError as error:
                connection.answer([number, "refused", 0, error.message])
            else:
                connection.answer([number, "done", result, ""])

    def _operations(self) -> dict[str, Callable[..., Any]]:
        wires, cameras = self.hardware.wires, self._cameras()

        def on_bus(name: str) -> Callable[..., Any]:
            return lambda connection, *a: getattr(wires.i2c(connection.selected), name)(*a)

        def select(connection: _DeviceClient, name: str) -> None:
            connection.selected = name

        def exchange(connection: _DeviceClient, address: int, data: list[int], count: int) -> list[int]:
            return list(wires.i2c(connection.selected).exchange(address, bytes(data), count))

        def spi(connection: _DeviceClient, frames: list[list[int]]) -> list[list[int]]:
            device = wires.spi(connection.selected or "", 0, 0)
            return [list(frame) for frame in device.transfer([bytes(frame) for frame in frames])]

        def trigger(connection: _DeviceClient, exposure_ns: int, number: int = 0) -> None:
            camera = cameras[number]
            if camera is not None:
                connection.wants_frames.add(number)
                camera.trigger(exposure_ns)

        return {
            **{name: on_bus(name) for name in _BUS_CALLS},
            "select": select,
            "exchange": exchange,
            "spi": spi,
            "release": lambda _, *a: self.release(*a),
            "lateness": lambda _: [self._late, self._latest_ns],
            "currents": lambda _: self.hardware.circuit.currents().tolist(),
            "trigger": trigger,
        }

    def release(self, epoch_ns: int, faults: Sequence[str] = (), flight_process: int | None = None) -> None:
        """Release the body and schedule the faults of a flight process."""
        self.hardware.release(epoch_ns)
        self._late = self._latest_ns = 0
        generator = self._faults_drawn
        line, gps_line = (
            cast(PtyLine, self.hardware.wires.line_of(kind)) for kind in ("inertial_unit", "gps")
        )
        bench = Bench(self.hardware, line, self._clock.now_ns, generator, None, flight_process, gps_line)
        put([parse(text) for text in faults], bench, epoch_ns)

    def _cameras(self) -> tuple[EmulatedCamera | None, ...]:
        """Return the cameras by number: 0 is the star camera, and 1 or more are the horizon cameras."""
        return self.hardware.camera, *self.hardware.orbit.wide

    def _deliver_frames(self) -> None:
        for number, camera in enumerate(self._cameras()):
            frame = camera.poll() if camera is not None else None
            if frame is None:
                continue
            path = self.socket_path.parent / f"frame-{number}-{self._frames_sent % _FRAME_SLOTS}.raw"
            self._frames_sent += 1
            try:
                path.write_bytes(frame.pixels.tobytes())
            except OSError as error:  # such as a full disk, which loses this frame but no other device
                sys.stderr.write(f"sim_hal: a frame is lost: {path}: {reason_of(error)}\n")
                continue
            times = frame.sequence, frame.exposure_start_ns, frame.exposure_ns
            description = [*times, list(frame.pixels.shape), frame.pixels.dtype.str]
            for connection in self._connections.values():
                if number in connection.wants_frames:
                    connection.answer([0, "frame", description, path.name])


def _renderer_pool(config: Config, section: Simulation) -> ProcessPoolExecutor | None:
    """Start the rendering process and wait until it has loaded the star catalogue."""
    if config.camera is None and not config.wide_cameras:
        return None
    pool = ProcessPoolExecutor(
        1,
        mp_context=get_context("spawn"),
        initializer=_prepare_renderer,
        initargs=(config.camera, section.sky, section.seed),
    )
    pool.submit(os.getpid).result()
    return pool
