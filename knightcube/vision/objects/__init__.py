"""Resident space objects in an image of stars (Sease chapter 4).

`detect` finds objects among streaks by their motion and tests with `star_light` whether stars explain their
pixels; `streak_ends` measures the ends of streaks. `measure` gives the directions of possible objects in
images whose stars are streaks or points.
"""
