"""Directions to an attitude: solvers of Wahba's problem.

`wahba` holds what all of them share (the attitude profile matrix, the loss, the covariance, which directions
fix an attitude), each other module one solver with the same signature: `esoq2`.
"""
