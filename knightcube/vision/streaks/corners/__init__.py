"""The thesis's method from a frame to a rate: corner detectors find the streaks' endpoints (Sease chapter 3).

In the order of the computation: `segmentation` (regions above the threshold), `corners` and `trajkovic`
(cornerness), `detectors` (the four by name), `endpoints` (peaks, to a fraction of a pixel), `streaks` (frame
to endpoints), `grouping` (which ends are simultaneous), `rate_fit` (robust rotation with a covariance),
`streak_rate` (all of these: a frame to a rate).
"""
