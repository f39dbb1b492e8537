"""The adjugate of a 3 x 3 matrix in plain floats, which is faster than numpy for this size."""

from __future__ import annotations

Rows = list[list[float]]


def adjugate(rows: Rows) -> Rows:
    """Return the adjugate of a 3 x 3 matrix given by its rows: the inverse times the determinant."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    return [
        [e * i - f * h, c * h - b * i, b * f - c * e],
        [f * g - d * i, a * i - c * g, c * d - a * f],
        [d * h - e * g, b * g - a * h, a * e - b * d],
    ]


def determinant(rows: Rows, adjugate_rows: Rows) -> float:
    """Return the determinant of a matrix with a known adjugate."""
    (a, b, c), column = rows[0], adjugate_rows
    return a * column[0][0] + b * column[1][0] + c * column[2][0]
