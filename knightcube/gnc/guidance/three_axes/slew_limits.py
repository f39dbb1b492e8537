"""The limits of a slew as inequalities: dipoles within their range, and cones kept.

All limits stand in one vector: the dipoles' lower and upper (2, k + 1, 3), then the cones' (cones, 2 k).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.three_axes.slew_cones import Kept
from knightcube.gnc.guidance.three_axes.slew_transcription import Trajectory, Transcription


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """The limits; `dipole` (3,) is in the unit of the motion, None for a slew without such a limit."""

    equations: Transcription
    dipole: FloatArray | None
    cones: Kept

    def values(self, at: Trajectory) -> FloatArray:
        """Return by how much every limit is kept."""
        found: list[FloatArray] = [np.zeros(0)]
        if self.dipole is not None:
            found += [(at.dipoles + self.dipole).ravel(), (self.dipole - at.dipoles).ravel()]
        if self.cones.count:
            found.append(self.cones.values(at.states[1:, :4]).ravel())
        return np.concatenate(found)

    def pull(self, at: Trajectory, weights: FloatArray) -> FloatArray:
        """Return the derivative (size,) of `weights` times the limits."""
        place = self.equations.layout
        result = np.zeros(place.size)
        dipoles, cones = self._parts(weights, at)
        if self.dipole is not None:
            result[place.dipoles] = dipoles[0] - dipoles[1]
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            result[place.states[1:, :4]] = np.einsum("cn,cnj->nj", cones, slopes)
        return result

    def along(self, at: Trajectory, change: FloatArray) -> FloatArray:
        """Return the change of every limit's value along a step (size,), linearly."""
        place = self.equations.layout
        found: list[FloatArray] = [np.zeros(0)]
        if self.dipole is not None:
            found += [change[place.dipoles].ravel(), -change[place.dipoles].ravel()]
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            found.append(np.einsum("cnj,nj->cn", slopes, change[place.states[1:, :4]]).ravel())
        return np.concatenate(found)

    def stiffness(self, at: Trajectory, stiff: FloatArray, bent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the limits add to the curvature by states (2 k + 1, 7, 7) and by dipoles (k + 1, 3).

        `stiff` are the squares' weights, `bent` those of the limits' own curvature.
        """
        dipoles, cones = self._parts(stiff, at)
        _, weights = self._parts(bent, at)
        states = np.zeros((len(at.states), 7, 7))
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            states[1:, :4, :4] = np.einsum("cn,cni,cnj->nij", cones, slopes, slopes)
            states[1:, :4, :4] -= np.einsum("cn,cnij->nij", weights, self.cones.curvatures)
        heavy = np.zeros_like(at.dipoles) if self.dipole is None else dipoles.sum(axis=0)
        return states, heavy

    def _parts(self, values: FloatArray, at: Trajectory) -> tuple[FloatArray, FloatArray]:
        """Split values of all limits into those of the dipoles and of the cones."""
        nodes = 0 if self.dipole is None else 2 * at.dipoles.size
        dipoles = values[:nodes].reshape(2, -1, 3) if nodes else values[:0]
        return dipoles, values[nodes:].reshape(self.cones.count, len(at.states) - 1)
