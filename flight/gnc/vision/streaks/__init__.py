"""Pixels to directions and rates: star streaks in one long exposure (Sease 2013, chapters 3 and 4).

One module, one step: `background` (level and noise), `segmentation` (regions), `corners` and `trajkovic`
(cornerness), `detectors` (the four by name), `endpoints` (peaks, sub-pixel), `streaks` (a frame to
endpoints), `grouping` (which ends are simultaneous), `olae` (the rotation between two sets of directions),
`rate_fit` (robust rotation with a covariance), `streak_rate` (all of it: a frame to a rate), `two_attitudes`
(the rate by way of identified stars); `rso_indicators` (what moves otherwise), `star_light` (what stars
explain), `objects` (the two together). Everything is pure and picklable, for a worker process.
"""
