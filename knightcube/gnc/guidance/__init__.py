"""Guidance: planning of energy-optimal paths from a state estimate, and selection of the path to follow.

Paths about one axis are planned by virtual motion camouflage in q2 (Sease 2013, eqs. (5.8) to (5.15)) in
`vmc` and `vmc_program` with the model `plant`, and followed by `path_guidance`. For a free satellite,
`attitude_law` computes the attitude of a `pointing_target`, and `slew_*` plan slews.
"""
