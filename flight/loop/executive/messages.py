"""Messages between the control process and its workers: a value, its large arrays in shared memory.

A worker trusts what the control process sends and unpickles it. What comes back is read without pickle's
powers: it may build dataclasses, enumerations and numpy arrays of modules that are loaded already, and call
or import nothing else. A worker whose memory is damaged can send a wrong value, never run code.
"""

from __future__ import annotations

import dataclasses
import enum
import io
import mmap
import pickle
import struct
import sys
import zlib
from collections.abc import Iterable
from typing import Any

from flight.gnc.errors import FlightError

SLAB_BYTES = 64 * 1024 * 1024
"""Shared memory for a job's arrays: only address space until used."""
LONGEST_BYTES = 16 * 1024 * 1024
"""A message without its arrays that claims to be longer is damaged."""

_HEADER = struct.Struct("<QQI")
"""Lengths of the arrays' sizes and of the body, and the CRC-32 of both."""
_BUILTINS = {"complex", "slice", "range"}
"""Sets and byte arrays have opcodes of their own; called by name, `bytearray` would fill gigabytes."""
_NUMPY = {"ndarray", "dtype", "scalar", "_frombuffer", "_reconstruct"}


def pack_message(value: Any, slab: mmap.mmap) -> bytes:
    """Pickle a value: its large buffers go into the slab, the rest is returned with its length in front."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    views = [buffer.raw() for buffer in buffers]
    if sum(view.nbytes for view in views) > len(slab):
        raise FlightError(f"a job's arrays exceed the {len(slab)} bytes that a worker's memory holds")
    offset = 0
    for view in views:
        slab[offset : offset + view.nbytes] = view
        offset += view.nbytes
    head = struct.pack(f"<{len(views)}Q", *(view.nbytes for view in views))
    return _HEADER.pack(len(head), len(body), zlib.crc32(body, zlib.crc32(head))) + head + body


def unpack_trusted(message: bytes, slab: mmap.mmap) -> Any:
    """Undo `pack_message` of a process that is trusted, copying the buffers out of the slab."""
    body, buffers = _parts(message, slab)
    return pickle.loads(body, buffers=buffers)


def unpack_values(message: bytes, slab: mmap.mmap) -> Any:
    """Undo `pack_message` of a worker: plain values only. Raises FlightError for anything else."""
    try:
        body, buffers = _parts(message, slab)
        return _ValueReader(io.BytesIO(body), buffers=buffers).load()
    except FlightError:
        raise
    except Exception as error:  # a damaged stream fails in any way
        raise FlightError(f"unreadable: {type(error).__name__}: {str(error)!r}") from error


def message_length(data: bytes | bytearray) -> int | None:
    """Return the length of the message that `data` begins with, None before the header is complete.

    Raises FlightError for a length that no message has.
    """
    if len(data) < _HEADER.size:
        return None
    head_length, body_length, _ = _HEADER.unpack_from(data)
    if (length := _HEADER.size + int(head_length) + int(body_length)) > LONGEST_BYTES:
        raise FlightError(f"a message of {length} bytes is damaged")
    return length


def _parts(message: bytes, slab: mmap.mmap) -> tuple[bytes, list[bytearray]]:
    head_length, body_length, crc = _HEADER.unpack_from(message)
    head_end = _HEADER.size + head_length
    if zlib.crc32(message[_HEADER.size : head_end + body_length]) != crc:
        raise FlightError("a message with a wrong checksum is damaged")
    buffers = []
    offset = 0
    with memoryview(slab) as view:
        for (size,) in struct.iter_unpack("<Q", message[_HEADER.size : head_end]):
            buffers.append(bytearray(view[offset : offset + size]))
            offset += size
    return message[head_end : head_end + body_length], buffers


class _ValueReader(pickle.Unpickler):
    """An unpickler that knows only classes of values."""

    def __init__(self, file: io.BytesIO, *, buffers: Iterable[bytearray]) -> None:
        super().__init__(file, buffers=buffers)

    def find_class(self, module_name: str, name: str) -> Any:
        """Return a class of values of a loaded module. Raises FlightError for any other name."""
        found = getattr(sys.modules.get(module_name), name, None)
        if module_name == "builtins":
            known = name in _BUILTINS
        elif module_name.partition(".")[0] == "numpy":
            known = name in _NUMPY
        else:
            known = isinstance(found, type) and (
                dataclasses.is_dataclass(found) or issubclass(found, enum.Enum) or _is_named_tuple(found)
            )
        if found is None or not known:
            full_name = f"{module_name}.{name}"
            raise FlightError(f"{full_name!r} is no class of values that the control process has")
        return found


def _is_named_tuple(found: type) -> bool:
    return issubclass(found, tuple) and hasattr(found, "_fields")
