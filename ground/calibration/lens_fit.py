"""The least-squares fit of a lens and of its frames' attitudes: residuals, derivatives, one step.

The attitudes, three small turns a frame, are eliminated frame by frame (Schur's complement), so that the
system solved is 5 x 5 however many frames there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import Lens

# Focal length px, centre x and y px, k1, k2.
PARAMETER_COUNT = 5
_LEAST_SPREAD = 1e-12
# Of the lens's information, every parameter in units of its own error with the others known.
_LEAST_INDEPENDENCE = 1e-10
# Cosine from the axis below which a star is no camera's: its match is wrong.
_LEAST_COSINE = 0.05


class CalibrationError(FlightError):
    """Frames from which no lens follows."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFrame:
    """Stars that were identified on one frame; a few may be the wrong ones.

    Attributes:
        points: (n, 2) px, measured.
        sigma: (n,) px, standard deviation of each along one axis.
        directions: (n, 3) unit vectors of the stars, in any frame that stays the same within the frame.
    """

    points: FloatArray
    sigma: FloatArray
    directions: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A lens's parameters (5,) and the frames' attitudes (m, 4), directions into camera."""

    parameters: FloatArray
    attitudes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What one step of the fit says.

    Attributes:
        fit: after the step.
        decrease: of the chi-square, as the linear model promises.
        information: (5, 5) of the lens by the stars alone, the attitudes unknown.
    """

    fit: Fit
    decrease: float
    information: FloatArray


def parameters_of(lens: Lens) -> FloatArray:
    """Return the lens's parameters (5,)."""
    return np.array([lens.focal_length, *lens.centre, lens.k1, lens.k2])


def residuals(frame: MatchedFrame, fit: Fit, number: int) -> FloatArray:
    """Return measured less predicted (n, 2), in sigmas, of the frame of that number.

    Infinite for a star that the camera would have at its side or its back.
    """
    focal_length, x, y, k1, k2 = fit.parameters
    seen = frame.directions @ attitude_matrix(fit.attitudes[number]).T
    ahead = seen[:, 2:] > _LEAST_COSINE
    tangent = seen[:, :2] / np.where(ahead, seen[:, 2:], 1.0)
    square = np.sum(tangent**2, axis=1, keepdims=True)
    predicted = focal_length * tangent * (1.0 + square * (k1 + square * k2)) + np.array([x, y])
    return np.where(ahead, (frame.points - predicted) / frame.sigma[:, None], np.inf)


def step(
    frames: Sequence[MatchedFrame],
    fit: Fit,
    weights: Sequence[FloatArray],
    prior: FloatArray,
    expected: FloatArray,
) -> Step:
    """Return the fit after one Gauss-Newton step.

    Each match's squared residual is multiplied by its weight (n,); `prior` (5,) is the information about each
    parameter's difference from `expected` (5,). Raises CalibrationError where a frame's matches do not fix
    its attitude, or nothing fixes the lens.
    """
    information, gradient = np.zeros((PARAMETER_COUNT, PARAMETER_COUNT)), np.zeros(PARAMETER_COUNT)
    turns, decrease = [], 0.0
    for number, frame in enumerate(frames):
        lens, turn, misfit = _linearised(frame, fit, number, weights[number])
        own = turn.T @ turn
        if np.linalg.eigvalsh(own)[0] <= _LEAST_SPREAD * np.trace(own):
            raise CalibrationError(f"frame {number}: its matches do not fix its attitude")
        inverse = np.linalg.inv(own)
        free, coupling = inverse @ (turn.T @ misfit), inverse @ (turn.T @ lens)
        turns.append((free, coupling))
        decrease += float(free @ (turn.T @ misfit))
        # What the lens does that no turn could do as well.
        beyond = lens - turn @ coupling
        information += beyond.T @ beyond
        gradient += beyond.T @ misfit
    gradient += prior * (expected - fit.parameters)
    change = _solved(information + np.diag(prior), gradient)
    attitudes = [
        normalise(multiply(from_rotation_vector(free - coupling @ change), attitude))
        for (free, coupling), attitude in zip(turns, fit.attitudes, strict=True)
    ]
    moved = Fit(fit.parameters + change, np.array(attitudes))
    return Step(moved, decrease + float(gradient @ change), information)


def _solved(information: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return information^-1 gradient, with the parameters brought to a common size first."""
    size = np.sqrt(np.diag(information))
    if not np.all(size > 0.0):
        raise CalibrationError("nothing is known of some parameter of the lens: give a prior")
    scaled = information / np.outer(size, size)
    if not np.linalg.eigvalsh(scaled)[0] > _LEAST_INDEPENDENCE:
        raise CalibrationError("the matches do not separate the lens's parameters: give a prior")
    return np.asarray(np.linalg.solve(scaled, gradient / size) / size)


def _linearised(
    frame: MatchedFrame, fit: Fit, number: int, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the weighed derivatives by the lens (2n, 5) and by the frame's turn (2n, 3), and misfits (2n,).

    Of direction v in the camera and tangent u, u is imaged at f u s(|u|^2); a turn moves v by v x turn.
    """
    misfit = residuals(frame, fit, number)
    believed = (weight > 0.0) & np.isfinite(misfit[:, 0])
    focal_length, _, _, k1, k2 = fit.parameters
    v = frame.directions[believed] @ attitude_matrix(fit.attitudes[number]).T
    u = v[:, :2] / v[:, 2:]
    square = np.sum(u**2, axis=1)
    stretch, slope = 1.0 + square * (k1 + square * k2), k1 + 2.0 * square * k2
    lens = np.zeros((len(u), 2, PARAMETER_COUNT))
    lens[:, :, 0] = u * stretch[:, None]
    lens[:, 0, 1] = lens[:, 1, 2] = 1.0
    lens[:, :, 3] = focal_length * u * square[:, None]
    lens[:, :, 4] = lens[:, :, 3] * square[:, None]
    by_tangent = focal_length * (
        stretch[:, None, None] * np.eye(2) + 2.0 * slope[:, None, None] * u[:, :, None] * u[:, None, :]
    )
    x, y = u.T
    one = np.ones_like(x)
    by_turn = np.array([[x * y, -one - x * x, y], [one + y * y, -x * y, -x]])
    turn = np.einsum("nij,jkn->nik", by_tangent, by_turn)
    scale = np.sqrt(weight[believed])
    over = (scale / frame.sigma[believed])[:, None, None]
    return (
        (lens * over).reshape(-1, PARAMETER_COUNT),
        (turn * over).reshape(-1, 3),
        (misfit[believed] * scale[:, None]).ravel(),
    )
