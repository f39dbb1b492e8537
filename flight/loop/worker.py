"""A worker process, and the messages between the control process and its workers.

The job runner starts a worker as `python -m flight.loop.worker MODULE:FUNCTION SOCKET_FD MEMORY_FD PARENT
CORES`. A worker serves one function until its socket closes. The function's module may define `prepare`,
which is called before the first job, for imports that only the worker needs. The kernel kills a worker when
the thread that started it ends, so that no worker outlives its flight.

Large arrays of a message are passed in shared memory. A worker trusts the control process, and unpickles its
messages. The control process decodes a worker's answer as plain values: decoding constructs dataclasses,
enumerations and arrays of numbers, but does not call or import anything else. A worker with damaged memory
may send a wrong value, but cannot run code in the control process or crash it. Answers are not pickled,
because numpy may crash when it unpickles damaged messages.

Plain values are encoded as MessagePack by msgspec. Numbers, texts, bytes and None are encoded directly; any
other value is encoded as a list that begins with a tag. The content of an array is in a separate buffer; its
type and shape are encoded as MessagePack. Only dataclasses, named tuples and enumerations of modules that are
already imported are constructed, and none of their own code is called.
"""

from __future__ import annotations

import ctypes
import dataclasses
import enum
import importlib
import math
import mmap
import operator
import os
import pickle
import signal
import socket
import struct
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from knightcube.errors import KnightCubeError

Array = npt.NDArray[Any]
_PLAIN = (bool, int, float, str, bytes, type(None))
_CONTAINERS: dict[type, str] = {list: "list", tuple: "tuple", set: "set", frozenset: "frozenset"}
_MAKERS: dict[str, Callable[[Any], Any]] = {name: kind for kind, name in _CONTAINERS.items()}
_DTYPES = {np.dtype(kind).str for kind in "?bBhHiIlLefdFD"}
_MOST_DIMENSIONS = 32


def encode_values(value: Any) -> tuple[bytes, list[Array]]:
    """Return the encoded bytes of a value, and its arrays. Raises KnightCubeError for an unsupported type."""
    arrays: list[Array] = []
    tree = _tree(value, arrays)
    try:
        return msgspec.msgpack.encode(tree), arrays
    except (OverflowError, UnicodeError) as error:
        raise KnightCubeError(f"the value cannot be sent: {error}") from error


def decode_values(data: bytes, buffers: Sequence[bytearray]) -> Any:
    """Decode a result, with arrays that are views of `buffers`. Damaged data may raise any exception."""
    return _Reader(buffers).made(msgspec.msgpack.decode(data))


def _tree(value: Any, arrays: list[Array]) -> Any:
    """Return a value as plain lists and scalars, and append its arrays to `arrays`."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind in _CONTAINERS:
        return [_CONTAINERS[kind], [_tree(item, arrays) for item in value]]
    if kind is dict:
        return ["dict", [[_tree(key, arrays), _tree(item, arrays)] for key, item in value.items()]]
    if isinstance(value, np.ndarray | np.generic) and value.dtype.str in _DTYPES:
        arrays.append(np.ascontiguousarray(value))
        return ["array" if isinstance(value, np.ndarray) else "scalar", value.dtype.str, list(value.shape)]
    return _tree_of_class(value, f"{kind.__module__}:{kind.__qualname__}", arrays)


def _tree_of_class(value: Any, name: str, arrays: list[Array]) -> list[Any]:
    if isinstance(value, complex):
        return ["complex", value.real, value.imag]
    if isinstance(value, enum.Flag):
        return ["flag", name, value.value]
    if isinstance(value, enum.Enum):
        return ["enum", name, value.name]
    if (parts := _field_names(type(value))) is None:
        raise KnightCubeError(f"a worker cannot send this value of class {name!r}")
    return ["fields", name, [_tree(getattr(value, part), arrays) for part in parts]]


class _Reader:
    """Decodes a value from plain lists and scalars; each array takes the next buffer."""

    def __init__(self, buffers: Sequence[bytearray]) -> None:
        self._buffers = iter(buffers)

    def made(self, tree: Any) -> Any:
        if type(tree) in _PLAIN:
            return tree
        match tree:
            case [str(tag), list(items)] if tag in _MAKERS:
                return _MAKERS[tag](map(self.made, items))
            case ["dict", list(items)]:
                return {self.made(key): self.made(item) for key, item in items}
            case ["fields", str(name), list(items)]:
                return _built(name, [self.made(item) for item in items])
        return self._single(tree)

    def _single(self, tree: Any) -> Any:
        match tree:
            case ["complex", float(real), float(imaginary)]:
                return complex(real, imaginary)
            case ["array", str(dtype), list(shape)]:
                return _array(dtype, shape, next(self._buffers))
            case ["scalar", str(dtype), []]:
                return _array(dtype, [], next(self._buffers))[()]
            case ["flag" | "enum" as tag, str(name), member]:
                return _member(name, tag, member)
        raise KnightCubeError(f"{str(tree)[:80]!r} does not encode a value")


def _array(dtype: str, shape: list[Any], buffer: bytearray) -> Array:
    """Return a writable array of numbers, which must have the size of its buffer."""
    if dtype not in _DTYPES or len(shape) > _MOST_DIMENSIONS:
        raise KnightCubeError(f"no array has type {dtype[:20]!r} and {len(shape)} dimensions")
    if not all(type(length) is int and length >= 0 for length in shape):
        raise KnightCubeError("the shape of an array is not a list of lengths")
    kind = np.dtype(dtype)
    if math.prod(shape) * kind.itemsize != len(buffer):
        raise KnightCubeError(f"an array of {dtype} and shape {shape} does not fill {len(buffer)} bytes")
    if kind.kind == "b" and buffer.translate(None, b"\0\1"):
        raise KnightCubeError("a boolean is neither 0 nor 1")
    return np.frombuffer(buffer, kind).reshape(shape) if buffer else np.zeros(shape, kind)


def _built(name: str, items: list[Any]) -> Any:
    kind: Any = _class(name)
    parts = _field_names(kind)
    if parts is None or len(parts) != len(items):
        raise KnightCubeError(f"{name!r} is not a class with {len(items)} fields")
    if issubclass(kind, tuple):
        return tuple.__new__(kind, items)
    value = object.__new__(kind)
    for part, item in zip(parts, items, strict=True):
        object.__setattr__(value, part, item)
    return value


def _member(name: str, tag: str, member: Any) -> Any:
    kind = _class(name)
    if not issubclass(kind, enum.Enum) or issubclass(kind, enum.Flag) != (tag == "flag"):
        raise KnightCubeError(f"{name!r} is not a class of kind {tag!r}")
    if tag == "flag":
        return kind(operator.index(member))
    return kind[member]


def _class(name: str) -> type:
    module, _, qualified = name.partition(":")
    found = getattr(sys.modules.get(module), qualified, None)
    if not isinstance(found, type):
        raise KnightCubeError(f"{name!r} is not a class that the control process has defined")
    return found


def _field_names(kind: Any) -> tuple[str, ...] | None:
    """Return the field names of a dataclass or named tuple, or None for any other class."""
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind))
    return kind._fields if issubclass(kind, tuple) and hasattr(kind, "_fields") else None


SLAB_BYTES = 64 * 1024 * 1024
"""Size (bytes) of the shared memory for a job's arrays; unused pages occupy no memory."""
LONGEST_BYTES = 16 * 1024 * 1024
"""Largest length (bytes) of a message without its arrays; a larger length indicates damage."""

_HEADER = struct.Struct("<QQI")
"""Header of a message: length of the list of array sizes, length of the body, and CRC-32 of both."""


def pack_trusted(value: Any, slab: mmap.mmap) -> bytes:
    """Pickle a value, with large buffers in the memory `slab`.

    Raises KnightCubeError if `slab` is too small.
    """
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    return _framed(body, [buffer.raw() for buffer in buffers], slab)


def unpack_trusted(message: bytes, slab: mmap.mmap) -> Any:
    """Unpickle a message of a trusted process, with copies of its buffers in the shared memory."""
    body, buffers = _parts(message, slab)
    return pickle.loads(body, buffers=buffers)


def pack_values(value: Any, slab: mmap.mmap) -> bytes:
    """Encode a value for a receiver that does not trust the sender.

    Raises KnightCubeError for an unsupported type, or if `slab` is too small.
    """
    body, arrays = encode_values(value)
    return _framed(body, [array.reshape(-1).view("u1").data for array in arrays], slab)


def unpack_values(message: bytes, slab: mmap.mmap) -> Any:
    """Return the value in a message from `pack_values`. Raises KnightCubeError for a damaged message."""
    try:
        return decode_values(*_parts(message, slab))
    except KnightCubeError:
        raise
    except Exception as error:  # damaged data may raise any exception
        raise KnightCubeError(f"unreadable: {type(error).__name__}: {str(error)!r}") from error


def message_length(data: bytes | bytearray) -> int | None:
    """Return the length of the message at the start of `data`, or None if its header is incomplete.

    Raises KnightCubeError for an impossible length.
    """
    if len(data) < _HEADER.size:
        return None
    head_length, body_length, _ = _HEADER.unpack_from(data)
    if (length := _HEADER.size + int(head_length) + int(body_length)) > LONGEST_BYTES:
        raise KnightCubeError(f"a message of {length} bytes is damaged")
    return length


def _framed(body: bytes, views: Sequence[memoryview], slab: mmap.mmap) -> bytes:
    if sum(view.nbytes for view in views) > len(slab):
        raise KnightCubeError(f"a job's arrays exceed the {len(slab)} bytes of a worker's memory")
    offset = 0
    for view in views:
        slab[offset : offset + view.nbytes] = view
        offset += view.nbytes
    head = struct.pack(f"<{len(views)}Q", *(view.nbytes for view in views))
    return _HEADER.pack(len(head), len(body), zlib.crc32(body, zlib.crc32(head))) + head + body


def _parts(message: bytes, slab: mmap.mmap) -> tuple[bytes, list[bytearray]]:
    head_length, body_length, crc = _HEADER.unpack_from(message)
    head_end = _HEADER.size + head_length
    if zlib.crc32(message[_HEADER.size : head_end + body_length]) != crc:
        raise KnightCubeError("a message with a wrong checksum is damaged")
    buffers = []
    offset = 0
    with memoryview(slab) as view:
        for (size,) in struct.iter_unpack("<Q", message[_HEADER.size : head_end]):
            buffers.append(bytearray(view[offset : offset + size]))
            offset += size
    return message[head_end : head_end + body_length], buffers


_SELDOM = {"char", "core", "ctypeslib", "f2py", "ma", "polynomial", "rec", "strings", "test", "testing"}
_PR_SET_PDEATHSIG = 1  # prctl(2)


def serve(function: Any, line: socket.socket, slab: mmap.mmap) -> None:
    """Announce readiness, then answer each job with (outcome, value, error, execution time in ns)."""
    line.sendall(pack_values(None, slab))
    received = bytearray()
    while chunk := line.recv(1 << 20):
        received += chunk
        while (length := message_length(received)) is not None and len(received) >= length:
            argument = unpack_trusted(bytes(received[:length]), slab)
            del received[:length]
            line.sendall(_answer(function, argument, slab))
            del argument
            # Memory is returned to the kernel after the result was sent, so that the result is not delayed.
            give_back()


def _answer(function: Any, argument: Any, slab: mmap.mmap) -> bytes:
    """Return a message with a job's result, or with an error if the result cannot be encoded."""
    outcome = _run(function, argument)
    try:
        return pack_values(outcome, slab)
    except KnightCubeError as error:
        return pack_values(("failed", None, str(error), outcome[3]), slab)


def _run(function: Any, argument: Any) -> tuple[str, Any, str, int]:
    begun = time.perf_counter_ns()
    try:
        value = function(argument)
    except Exception as error:  # noqa: BLE001 - containment boundary: the worker runner
        return "failed", None, f"{type(error).__name__}: {error}", time.perf_counter_ns() - begun
    return "done", value, "", time.perf_counter_ns() - begun


def end_with(parent: int) -> None:
    """Let the kernel kill this process when its parent ends, and exit if the parent has already ended."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(0)


def give_back() -> None:
    """Return free heap memory to the kernel: tens of megabytes after a frame, in about 2 ms."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


_ARRAY_API = "scipy._lib._array_api"


class _WithoutTables(MetaPathFinder):
    """Import hook that prevents scipy from adding a table of array libraries to its functions' docstrings.

    Scipy adds the table to 170 docstrings, which takes two thirds of the import time of `scipy.special`.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a module spec for scipy's `_array_api`, in which its decorator has no effect."""
        if name != _ARRAY_API:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def without_tables(module: ModuleType) -> None:
                execute(module)
                if hasattr(module, "xp_capabilities"):
                    vars(module)["xp_capabilities"] = lambda **_: lambda function: function

            vars(spec.loader)["exec_module"] = without_tables
        return spec


def lean_imports() -> None:
    """Reduce what scipy imports, which saves 11 MiB and 0.3 s of processor time in each process.

    This function must be called before scipy is imported. In scipy/_lib/array_api_compat, scipy copies every
    name that numpy lists, and so imports numpy's masked arrays, test support and Fortran reader. The function
    removes these modules from numpy's list of names; they can still be imported explicitly. The function also
    prevents scipy from extending its docstrings. With different versions of numpy and scipy, the function may
    have no effect.
    """
    np.__all__ = [name for name in np.__all__ if name not in _SELDOM]
    lazy = getattr(np, "__numpy_submodules__", None)
    if isinstance(lazy, set):
        lazy -= _SELDOM
    if _ARRAY_API not in sys.modules and not any(isinstance(one, _WithoutTables) for one in sys.meta_path):
        sys.meta_path.insert(0, _WithoutTables())


def main(arguments: list[str]) -> None:
    """Import the worker's function, then serve jobs until the socket closes."""
    function_name, socket_fd, memory_fd, parent, cores = arguments
    end_with(int(parent))
    module, _, name = function_name.partition(":")
    os.nice(5)  # the control loop has priority
    if cores:
        os.sched_setaffinity(0, map(int, cores.split(",")))
    lean_imports()
    home = importlib.import_module(module)
    if (prepare := getattr(home, "prepare", None)) is not None:
        prepare()
    function = getattr(home, name)
    line = socket.socket(fileno=int(socket_fd))
    slab = mmap.mmap(int(memory_fd), SLAB_BYTES)
    try:
        serve(function, line, slab)
    except ConnectionError:
        return  # the control process ended


if __name__ == "__main__":
    main(sys.argv[1:])
