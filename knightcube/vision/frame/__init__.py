"""What every method asks of a frame of stars first, of points and of streaks alike.

`saturation` (at which count pixels clip, whether the frame can be used), `background` (level and noise),
`hot_pixels`, `box_sums` (light of 3 x 3 pixels), `regions` (connected pixels and their moments).
"""
