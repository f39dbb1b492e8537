"""Array types, checks of arguments, row selection in dataclasses of arrays, and vector products."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from knightcube.errors import ArgumentError

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Image = npt.NDArray[Any]

Record = TypeVar("Record")


def finite_array(name: str, value: npt.ArrayLike, *shapes: tuple[int, ...]) -> FloatArray:
    """Return the argument `name` of a public function as an array of finite numbers.

    Raises ArgumentError for values that are not numbers or are complex, infinite or NaN, for masked elements,
    whose values are meaningless, and for an array whose shape is not one of `shapes`. If no `shapes` are
    given, every shape is permitted.
    """
    if np.ma.is_masked(value):
        count = np.count_nonzero(np.ma.getmaskarray(np.ma.asarray(value)))
        raise ArgumentError(name, f"{count} masked elements: replace them by finite numbers")
    found = _as_floats(name, value, "give finite numbers")
    if shapes and found.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise ArgumentError(name, f"an array of shape {found.shape}: give finite numbers of shape {wanted}")
    if not np.isfinite(found).all():
        raise ArgumentError(name, f"{brief(found.tolist())}: give finite numbers")
    return found


def check_finite(**given: FloatArray | float) -> None:
    """Raise ArgumentError, with the name, for an argument that contains NaN, infinity or no numbers."""
    for name, value in given.items():
        try:
            finite = bool(np.isfinite(value).all())
        except TypeError:
            finite = False
        if not finite:
            raise ArgumentError(name, f"{brief(np.asarray(value).tolist())}: give finite numbers")


def checked_number(name: str, value: float, unit: str) -> float:
    """Return the argument `name` in `unit`. Raises ArgumentError unless it is a positive, finite number."""
    number = real_number(value)
    if not 0.0 < number < math.inf:
        raise ArgumentError(name, f"{brief(value)}: give a positive, finite number of {unit}")
    return number


def checked_deviation(name: str, value: float, unit: str) -> float:
    """Return the standard deviation `name` in `unit`; infinity stands for an unknown value.

    Raises ArgumentError unless the standard deviation is a number that is not negative.
    """
    number = real_number(value)
    if not number >= 0.0:
        raise ArgumentError(name, f"{brief(value)}: give a standard deviation of 0 {unit} or more")
    return number


def real_number(value: object) -> float:
    """Return an integer or a floating-point number as a float, and NaN for any other value."""
    return float(np.asarray(value)) if _is_number(value) else math.nan


def check_numbers(**given: object) -> None:
    """Raise ArgumentError with the name of the argument if an argument is not a number."""
    for name, value in given.items():
        if not _is_number(value):
            raise ArgumentError(name, f"{brief(value)}: give a number")


def _is_number(value: object) -> bool:
    """Return whether a value is an integer or a floating-point number that numpy can store."""
    if isinstance(value, float):  # without numpy, which takes ten times as long
        return True
    try:
        found = np.asarray(value)
    except (TypeError, ValueError):
        return False
    return found.ndim == 0 and found.dtype.kind in "uif"


def float_rows(name: str, value: npt.ArrayLike, count: int) -> FloatArray:
    """Return the argument `name` of a public method as an array (..., count) of numbers, which may be NaN.

    Raises ArgumentError for values that are not numbers, and for an array of another shape.
    """
    found = value if isinstance(value, np.ndarray) and value.dtype == float else None
    if found is None:
        found = _as_floats(name, value, f"give numbers of shape (n, {count})")
    if found.shape[-1:] != (count,):
        raise ArgumentError(name, f"an array of shape {found.shape}: give numbers of shape (n, {count})")
    return found


def _as_floats(name: str, value: npt.ArrayLike, remedy: str) -> FloatArray:
    """Return a new array of the numbers in `value`. Raises ArgumentError for texts, dates and other types."""
    try:
        if np.asarray(value).dtype.kind not in "buifO":
            raise TypeError
        return np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(name, f"{brief(value)}: {remedy}") from None


_LONGEST_TEXT = 100


def brief(value: object) -> str:
    """Return the representation of a value in one line of at most `_LONGEST_TEXT` characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST_TEXT else f"{text[: _LONGEST_TEXT - 3]}..."


def check_type(name: str, value: object, kind: type[object]) -> None:
    """Raise ArgumentError unless the argument `name` of a public function is an object of a class.

    The numbers of a dataclass are checked too (`check_fields`).
    """
    if not isinstance(value, kind):
        raise ArgumentError(name, f"{brief(value)}: give an object of the class {kind.__name__}")
    if is_dataclass(value):
        check_fields(value, f"{name}.")


def check_fields(settings: Any, prefix: str = "") -> None:
    """Raise ArgumentError unless the fields of a dataclass that are annotated as int or float are numbers.

    Fields annotated as int must be whole numbers. If the value of a field is a dataclass, its fields are also
    checked. The text `prefix` precedes the names.
    """
    for field in fields(settings):
        value = getattr(settings, field.name)
        if field.type == "int" and not isinstance(value, (int, np.integer)):
            raise ArgumentError(prefix + field.name, f"{brief(value)}: give a whole number")
        is_real = field.type == "float" or (field.type == "float | None" and value is not None)
        if is_real and not _is_number(value):
            raise ArgumentError(prefix + field.name, f"{brief(value)}: give a number")
        if is_dataclass(value):
            check_fields(value, f"{prefix}{field.name}.")


_UNIT = 1e-12
"""Largest difference between the length of a vector and 1 with which the vector is not normalised again."""


def unit_vector(name: str, value: npt.ArrayLike) -> FloatArray:
    """Return the direction `name` of a public function as a unit vector (3,).

    A vector of another length is normalised. Raises ArgumentError unless the vector is finite and not zero.
    """
    vector = finite_array(name, value, (3,))
    length = math.hypot(*vector.tolist())
    if not 0.0 < length < math.inf:
        raise ArgumentError(name, f"{vector.tolist()}: give a direction, whose length is not zero")
    return vector if abs(length - 1.0) <= _UNIT else np.asarray(vector / length)


_ROUGHLY_UNIT = 1e-3
"""Largest deviation of the length of a given quaternion from 1."""


def unit_quaternion(name: str, value: npt.ArrayLike) -> FloatArray:
    """Return the attitude `name` of a public function as a unit quaternion (4,).

    The quaternion is normalised. Raises ArgumentError unless the quaternion is finite and its length differs
    from 1 by at most 0.001.
    """
    quaternion = finite_array(name, value, (4,))
    length = math.hypot(*quaternion.tolist())
    if abs(length - 1.0) > _ROUGHLY_UNIT:
        text = f"{quaternion.tolist()}: length {length:g}: give a quaternion of length 1, scalar part last"
        raise ArgumentError(name, text)
    return quaternion if abs(length - 1.0) <= _UNIT else np.asarray(quaternion / length)


def select(record: Record, chosen: BoolArray | IntArray, *common: str) -> Record:
    """Return a copy of a dataclass of arrays (`record`) that contains only the selected rows.

    The selection `chosen` is a Boolean mask (n,) or indices. The fields named in `common` remain unchanged.
    """
    # Indices select rows of many arrays faster than a mask.
    rows = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
    kind: Any = type(record)
    kept = [
        getattr(record, name) if name in common else getattr(record, name).take(rows, axis=0)
        for name in _names(kind)
    ]
    selected: Record = kind(*kept)
    return selected


@functools.cache
def _names(kind: type[Any]) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass."""
    return tuple(field.name for field in fields(kind))


def median(values: npt.NDArray[np.floating[Any]]) -> float:
    """Return the median of finite `values` (n,), several times as fast as numpy.median for small n."""
    ordered, middle = np.sort(values, axis=None), values.size // 2
    if values.size % 2:
        return float(ordered[middle])
    return 0.5 * (float(ordered[middle - 1]) + float(ordered[middle]))


def tangent_basis(direction: Iterable[float]) -> FloatArray:
    """Return two orthogonal unit vectors (2, 3) perpendicular to a unit vector (3,).

    The two vectors and the given vector, in this order, form a right-handed frame.
    """
    # Python floats are used, because numpy takes ten times as long for a single vector.
    x, y, z = map(float, direction)
    # The first vector is perpendicular to the coordinate axis that is farthest from the given vector.
    farthest = min((abs(x), 0), (abs(y), 1), (abs(z), 2))[1]
    first = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[farthest]
    length = math.hypot(*first)
    a, b, c = first[0] / length, first[1] / length, first[2] / length
    return np.array(((a, b, c), (y * c - z * b, z * a - x * c, x * b - y * a)))


def cross_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product a x b of vectors (3,), ten times as fast as numpy.cross."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def cross_matrix(vector: FloatArray) -> FloatArray:
    """Return the cross-product matrix [v x] (3, 3) of a vector v (3,)."""
    x, y, z = vector.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return the cross-product matrices [v x] (n, 3, 3) of vectors v (n, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices
