"""A free body in low Earth orbit: craft, environment, disturbances and the rotation that they cause."""
