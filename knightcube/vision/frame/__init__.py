"""Properties of a frame of stars that the methods for points and for streaks share.

`saturation` gives the count at which pixels saturate and whether the frame can be used, `background` the
local level and noise and the sums over 3 x 3 pixels, and `regions` connected pixels, their moments and hot
pixels.
"""
