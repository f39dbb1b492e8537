"""Identification: the constants of the body on its thread, from a short flight made for that.

    excitation (flown by the loop) -> flight log -> record -> fit -> absolute scale -> configuration fragment

Motion under a known current shows ratios to the inertia only. `scale` says what the configuration and the
magnetometer must add, and how much of each constant rests on them.
"""
