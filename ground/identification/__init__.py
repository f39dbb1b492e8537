"""Identification of the body on its thread from a short flight.

    excitation (flown by the loop) -> flight log -> record -> fit -> absolute scale -> `plant` section

Motion under a known current determines ratios to the inertia only. `scale` adds prior values from the
configuration and the magnetometer, and states the contribution of each.
"""
