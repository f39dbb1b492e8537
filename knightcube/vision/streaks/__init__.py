"""Star streaks in one long exposure: from the pixels to directions and the camera's rate.

`maximum_likelihood` fits one rotation and all stars to all pixels; `corners` is the thesis's method (Sease
2013, chapter 3): corner detectors find the streaks' ends. Both admit a frame by `admission` and return a
`streak_result`. Everything is pure and picklable, for a worker process.
"""
