"""Detection of resident space objects in images of stars (Sease, chapter 4).

`detect` finds objects among the streaks of an image by their motion, and tests with `star_light` whether
stars explain the pixels. `streak_ends` measures the two ends of streaks. `measure` gives the directions of
possible objects in images whose stars are streaks or points.
"""
