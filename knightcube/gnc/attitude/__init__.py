"""Attitude from Sun, nadir, magnetic field and gyros (Meller et al., section 2 and Fig. 3).

Sun, nadir  ->  single_frame: TRIAD, QUEST, the optimum, and with the field  ->  start
gyros, Sun, nadir, field, each at its own time  ->  direction_filter: the MEKF  ->  attitude, sigma, status
"""
