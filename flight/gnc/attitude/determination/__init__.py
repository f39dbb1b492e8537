"""Sun, nadir, field and gyros to one attitude (Meller et al., section 2 and Fig. 3).

Sun, nadir  ->  single_frame: TRIAD, QUEST, the optimum, and with the field  ->  start
gyros, Sun, nadir, field, each at its own time  ->  determination: the MEKF  ->  attitude, sigma, status
"""
