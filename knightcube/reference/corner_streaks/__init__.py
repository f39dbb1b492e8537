"""Body rate and attitude from star streaks by corner detectors (Sease 2013, chapters 3 and 4).

The module `settings` defines settings and results, and `estimator` defines the object that a configuration
selects. The modules `settings` and `estimator` do not import scipy. The module `detectors` contains the
corner detectors. The module `rate` fits a rotation to the ends of the streaks, and `two_ends` determines the
attitudes at the start and end of the exposure.
"""
