"""The limit of q2, without numpy: the configuration's reader needs it at once."""

Q2_LIMIT = 0.68
"""No path leads beyond: cos(theta) is 0.075 there; at 0.707 no current turns the body at all."""
