"""Resident space objects in a frame of stars (Sease chapter 4).

`detect` finds objects among streaks: `rso_indicators` selects the streaks that do not move as the stars do,
`star_light` tests whether stars explain the pixels, and `merged` searches a region once its stars are
removed.

`measure` gives the directions of possible objects among the stars, in frames of streaks or of points.
"""
