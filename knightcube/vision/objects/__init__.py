"""Detection of resident space objects in images of stars (Sease, chapter 4).

`detect` finds objects among the streaks of an image by their motion, and `star_light` tests whether stars
alone explain the pixels. `streak_ends` segments a frame into bright regions and measures the two ends of
streaks. `measure` computes the directions of possible objects in images of streaked stars or point stars.
"""
