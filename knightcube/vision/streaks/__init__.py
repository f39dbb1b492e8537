"""Star streaks in one long exposure: from the pixels to directions and the camera's rate.

The maximum-likelihood estimator fits one rotation and all stars to all pixels. In the order of the
computation: `frame` (background, noise, regions), `first_guess` (axis and angle of the rotation),
`faint_stars` (matched filter along the motion), `joint_fit` (motion and stars together, with
`normal_equations` and `streak_model`), `uncertainty` (covariance) and `estimate`, which runs them all.
`geometry` describes the paths of the stars. All functions are pure, and their arguments and results can be
pickled for a worker process.
"""
