"""Solution of the normal equations of stars that share pixels, by conjugate gradients.

The equations without the coupling of stars are the preconditioner, so that few iterations suffice. A vector
of all parameters consists of the s parameters common to all stars, followed by a further parameters for each
of the n stars.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper

# Squared residual norm, relative to the squared norm of the first step, at which conjugate gradients stop.
_CONVERGED = 1e-2

Crowd = tuple[IntArray, FloatArray, IntArray, IntArray, Float32Array, Float32Array]
"""The arrays `star`, `matrix`, `first`, `slot`, `weight` and `images` of `normal_equations.SharedPixels`."""
NO_CROWD: Crowd = (
    np.zeros(0, np.int64),
    np.zeros((0, 1, 1)),
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros(0, np.float32),
    np.zeros((1, 0), np.float32),
)
"""The value of type `Crowd`, with empty arrays, for stars that do not share pixels."""
_Alone = tuple[IntArray, FloatArray, FloatArray, FloatArray]
"""The arrays `kept`, `own`, `gain` and `inner` of `normal_equations.EliminatedEquations`."""


def _solution_numpy(
    information: FloatArray,
    prior: FloatArray,
    crowds: tuple[Crowd, Crowd],
    common: int,
    eliminated: _Alone,
    free: BoolArray,
    right: FloatArray,
    rounds: int,
) -> FloatArray:
    """Return the result of `solution`."""
    x = _without_coupling(eliminated, right, len(free))
    if rounds == 0:
        return x

    def product(vector: FloatArray) -> FloatArray:
        return _product(information, prior, crowds, common, free, vector)

    residual = right - product(x)
    z = _without_coupling(eliminated, residual, len(free))
    direction, size, first = z, float(residual @ z), abs(float(right @ x))
    for _ in range(rounds):
        if size <= _CONVERGED * first:
            break
        image = product(direction)
        length = size / float(direction @ image)
        x = x + length * direction
        residual = residual - length * image
        z = _without_coupling(eliminated, residual, len(free))
        size, before = float(residual @ z), size
        direction = z + size / before * direction
    return x


def _without_coupling(eliminated: _Alone, right: FloatArray, shared: int) -> FloatArray:
    """Return the solution of the equations without coupling of stars, with `shared` shared parameters."""
    kept, own, gain, inner = eliminated
    alone = right[shared:].reshape(gain.shape[0], -1)
    step = inner @ (right[kept] - np.einsum("nij,nj->i", gain, alone))
    out = np.zeros_like(right)
    out[kept] = step
    out[shared:] = (np.einsum("nij,nj->ni", own, alone) - step @ gain).reshape(-1)
    return out


def _product(
    information: FloatArray,
    prior: FloatArray,
    crowds: tuple[Crowd, Crowd],
    common: int,
    free: BoolArray,
    parameters: FloatArray,
) -> FloatArray:
    """Return the product of the information matrix of the whole scene with a vector of parameters.

    The coupling of a star is the change of the modelled counts on its shared pixels due to all other stars.
    """
    n, shared = len(information), len(free)
    alone = parameters[shared:].reshape(n, -1)
    vector = np.concatenate([np.broadcast_to(parameters[:shared], (n, shared)), alone], axis=1)
    out = (information @ vector[..., None])[..., 0]
    change, lights = np.zeros(common), []
    held = [crowd for crowd in crowds if len(crowd[0])]
    for star, matrix, first, slot, _, images in held:
        mixture = (matrix @ vector[star][..., None])[..., 0].T.astype(np.float32)
        block = np.repeat(np.arange(len(first)), np.diff(first, append=len(slot)))
        lights.append(np.einsum("ie,ie->e", mixture.take(block, axis=1), images))
        change += np.bincount(slot, lights[-1], common)
    for (star, matrix, first, slot, weight, images), light in zip(held, lights, strict=True):
        weighted = weight * (change[slot] - light).astype(np.float32)
        slope = np.add.reduceat(images * weighted, first, axis=1).T.astype(np.float64)
        np.add.at(out, star, (slope[:, None] @ matrix)[:, 0])
    total = np.where(free, out[:, :shared].sum(axis=0), 0.0)
    return np.concatenate([total, (out[:, shared:] + prior * alone).reshape(-1)])


@compiled_form_of(_solution_numpy)
def solution(
    information: FloatArray,
    prior: FloatArray,
    crowds: tuple[Crowd, Crowd],
    common: int,
    eliminated: _Alone,
    free: BoolArray,
    right: FloatArray,
    rounds: int,
) -> FloatArray:
    """Return the vector of parameters (s + n a,) that solves the coupled normal equations.

    Args:
        information: Fisher information (n, s + a, s + a) from the pixels of each star, on the shared
            parameters and on the parameters of that star.
        prior: prior information on the parameters of a single star (a,).
        crowds: derivatives of the modelled counts on the shared pixels of strips and of patches.
        common: number of pixels that several stars share.
        eliminated: solution of the equations without coupling.
        free: mask (s,) of the fitted shared parameters.
        right: right-hand side (s + n a,).
        rounds: maximum number of iterations. If `rounds` is 0, the coupling is neglected.
    """
    x, image, z = np.empty_like(right), np.empty_like(right), np.empty_like(right)
    change, scratch = np.empty(common), np.empty((2, *information.shape[:2]))
    light = np.empty(len(crowds[0][3]) + len(crowds[1][3]), dtype=np.float32)
    _solve_alone(eliminated, right, len(free), x)
    if rounds == 0:
        return x
    _multiply(information, prior, crowds, free, x, change, light, scratch, image)
    residual = right - image
    _solve_alone(eliminated, residual, len(free), z)
    direction, size, first = z.copy(), _scalar_product(residual, z), abs(_scalar_product(right, x))
    for _ in range(rounds):
        if size <= _CONVERGED * first:
            break
        _multiply(information, prior, crowds, free, direction, change, light, scratch, image)
        length = size / _scalar_product(direction, image)
        for k in range(len(x)):
            x[k] += length * direction[k]
            residual[k] -= length * image[k]
        _solve_alone(eliminated, residual, len(free), z)
        before = size
        size = _scalar_product(residual, z)
        for k in range(len(x)):
            direction[k] = z[k] + size / before * direction[k]
    return x


@loop_helper
def _solve_alone(eliminated: _Alone, right: FloatArray, shared: int, out: FloatArray) -> None:
    """Set `out` to the result of `_without_coupling`."""
    kept, own, gain, inner = eliminated
    alone, left = own.shape[1], np.empty(len(kept))
    for i in range(len(kept)):
        left[i] = right[kept[i]]
    for star in range(len(own)):
        of_star = right[shared + alone * star : shared + alone * (star + 1)]
        for i in range(len(kept)):
            left[i] -= _scalar_product(gain[star, i], of_star)
    out[:] = 0.0
    for i in range(len(kept)):
        out[kept[i]] = _scalar_product(inner[i], left)
    for star in range(len(own)):
        begin = shared + alone * star
        of_star = right[begin : begin + alone]
        for j in range(alone):
            out[begin + j] = _scalar_product(own[star, j], of_star)
            for i in range(len(kept)):
                out[begin + j] -= out[kept[i]] * gain[star, i, j]


@loop_helper
def _multiply(
    information: FloatArray,
    prior: FloatArray,
    crowds: tuple[Crowd, Crowd],
    free: BoolArray,
    parameters: FloatArray,
    change: FloatArray,
    light: Float32Array,
    scratch: FloatArray,
    product: FloatArray,
) -> None:
    """Set `product` to the result of `_product`.

    The arrays `change` (common,), `light` (e,) for e shared pixels of all stars, and `scratch` (2, n, s + a)
    are overwritten.
    """
    vector, out, shared, alone, begin = scratch[0], scratch[1], len(free), len(prior), 0
    for star in range(len(information)):
        vector[star, :shared] = parameters[:shared]
        vector[star, shared:] = parameters[shared + alone * star : shared + alone * (star + 1)]
        for i in range(shared + alone):
            out[star, i] = _scalar_product(information[star, i], vector[star])
    change[:] = 0.0
    for crowd in crowds:
        _add_changes(crowd, vector, light[begin : begin + len(crowd[3])], change)
        begin += len(crowd[3])
    begin = 0
    for crowd in crowds:
        _add_coupling(crowd, change, light[begin : begin + len(crowd[3])], out)
        begin += len(crowd[3])
    product[:shared] = 0.0
    for star in range(len(out)):
        for k in range(shared):
            product[k] += out[star, k] if free[k] else 0.0
        for k in range(alone):
            place = shared + alone * star + k
            product[place] = out[star, shared + k] + prior[k] * parameters[place]


@loop_helper
def _add_changes(crowd: Crowd, vector: FloatArray, light: Float32Array, change: FloatArray) -> None:
    """Set `light` (e,) to the change of each star's counts due to the parameter step `vector` (n, s + a).

    The changes of all stars on the same pixel are added to `change`.
    """
    star, matrix, first, slot, _, images = crowd
    light[:] = 0.0
    for b in range(len(first)):
        stop = first[b + 1] if b + 1 < len(first) else len(slot)
        for i in range(len(images)):
            share = np.float32(_scalar_product(matrix[b, i], vector[star[b]]))
            _add_scaled(light[first[b] : stop], share, images[i, first[b] : stop])
    for e in range(len(slot)):
        change[slot[e]] += light[e]


@loop_helper
def _add_coupling(crowd: Crowd, change: FloatArray, light: Float32Array, out: FloatArray) -> None:
    """Add the effect of other stars to the product `out` (n, s + a); `light` is overwritten."""
    star, matrix, first, slot, weight, images = crowd
    for e in range(len(slot)):
        light[e] = weight[e] * (change[slot[e]] - light[e])
    for b in range(len(first)):
        stop = first[b + 1] if b + 1 < len(first) else len(slot)
        for i in range(len(images)):
            slope = float(_scalar_product(light[first[b] : stop], images[i, first[b] : stop]))
            _add_scaled(out[star[b]], slope, matrix[b, i])


@loop_helper
def _scalar_product(a: Any, b: Any) -> Any:
    """Return the scalar product of two arrays (m,) of one type, in this type."""
    total = a.dtype.type(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@loop_helper
def _add_scaled(total: Any, factor: Any, values: Any) -> None:
    for k in range(len(total)):
        total[k] += factor * values[k]
