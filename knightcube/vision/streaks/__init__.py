"""Estimation of star directions and of the camera's rate from the star streaks in one long exposure.

The maximum-likelihood estimator fits one camera rotation and the parameters of all stars to all pixels. In
the order of the computation, the modules are `frame` (background, noise and bright regions), `first_guess`
(axis and angle of the rotation), `faint_stars` (matched filter along the motion, with `polar_grid`),
`joint_fit` (simultaneous fit of motion and stars, with `normal_equations` and `streak_model`) and
`uncertainty` (covariance). The module `estimate` runs the complete computation. The module `geometry`
computes the paths of the stars on the detector. All functions of this package are pure, and their arguments
and results can be pickled for a worker process.
"""
