"""The error state of a Kalman filter as a declared list of blocks.

Each block is a vector with a name, a prior covariance, a random walk and a role. An estimated block is
corrected by measurements. A considered block (Schmidt 1966) is not corrected, but its uncertainty and its
correlations enter the gains and the covariance of all other blocks. A fixed block is known exactly. The role
of a block can therefore be changed without a change of the filter's equations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.errors import UsageError


class Role(Enum):
    """Treatment of a block of the error state."""

    ESTIMATED = "estimated"
    CONSIDERED = "considered"
    FIXED = "fixed"


@dataclass(frozen=True, slots=True, eq=False)
class StateBlock:
    """A vector (n,) of the error state.

    Attributes:
        name: name of the block, unique within the list.
        prior: standard deviations (n,) or covariance (n, n) at the start.
        walk: standard deviations (n,) of the random walk per sqrt(s); a single number applies to all.
        role: treatment of the block.
    """

    name: str
    prior: FloatArray
    walk: FloatArray | float = 0.0
    role: Role = Role.ESTIMATED


def slices(sizes: Mapping[str, int]) -> list[slice]:
    """Return the indices of blocks with these sizes by name, one after the other."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return [slice(end - size, end) for end, size in zip(ends, sizes.values(), strict=True)]


class ErrorState:
    """The layout of an error state.

    Attributes:
        sizes: sizes of the blocks by name, in order.
        size: number of elements.
        prior: covariance (size, size) at the start; zero for fixed blocks.
        walks: variances (size,) of the random walks per second; zero for fixed blocks.
        considered: flags (size,) of the elements of considered blocks, or None without such a block.
    """

    def __init__(self, blocks: Sequence[StateBlock]) -> None:
        """Place the blocks one after the other. Raises UsageError for two blocks with one name."""
        self.sizes = {block.name: len(block.prior) for block in blocks}
        if len(self.sizes) < len(blocks):
            raise UsageError(f"two blocks of the error state have one name: {[b.name for b in blocks]}")
        self.size = sum(self.sizes.values())
        self.prior: FloatArray = np.zeros((self.size, self.size))
        self.walks: FloatArray = np.zeros(self.size)
        considered: BoolArray = np.zeros(self.size, dtype=bool)
        for block, at in zip(blocks, slices(self.sizes), strict=True):
            if block.role is Role.FIXED:
                continue
            self.prior[at, at] = block.prior if np.ndim(block.prior) == 2 else np.diag(block.prior**2)
            self.walks[at] = np.square(block.walk)
            considered[at] = block.role is Role.CONSIDERED
        self.considered = considered if considered.any() else None

    def kalman_update(
        self, covariance: FloatArray, gain: FloatArray, cross: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the covariance after a measurement, and the gain that corrects the state.

        `gain` (size, k) is the optimal gain, `cross` (size, k) the covariance of state and innovation. The
        correction of considered elements is zero, and their covariance among each other does not change.
        """
        change = gain @ cross.T
        if self.considered is not None:
            change[np.ix_(self.considered, self.considered)] = 0.0
            gain = np.where(self.considered[:, None], 0.0, gain)
        covariance = covariance - change
        return 0.5 * (covariance + covariance.T), gain


def with_role(blocks: Sequence[StateBlock], roles: Mapping[str, Role]) -> list[StateBlock]:
    """Return the blocks with other roles by name. Raises UsageError for a name without a block."""
    unknown = sorted(roles.keys() - {block.name for block in blocks})
    if unknown:
        raise UsageError(f"the error state has no block {', '.join(unknown)}")
    return [dataclasses.replace(block, role=roles.get(block.name, block.role)) for block in blocks]
