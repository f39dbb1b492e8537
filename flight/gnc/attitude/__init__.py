"""Directions to an attitude: solvers of Wahba's problem.

    observed, reference, sigma -> sightings -> B -> a solver's quaternion -> settle -> AttitudeFix

`wahba` checks the directions, holds their sums and settles an attitude on the least loss with its covariance;
`profile` is what solvers take from the profile matrix B; each other module is one solver of the same
signature; `solvers` has them by name.
"""
