"""Attitude from directions: solvers of Wahba's problem.

    observed, reference, sigma -> sightings -> B -> a solver's quaternion -> settle -> AttitudeFix

`wahba` checks the directions, computes their sums and refines an attitude to the least loss, with its
covariance; `profile` holds the functions of the profile matrix B that solvers share; each other module is one
solver of the same signature; `solvers` lists them by name.
"""
