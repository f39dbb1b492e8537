"""The thesis's method for streaks (Sease 2013, chapters 3 and 4).

`settings` holds settings and result, `estimator` the object that a configuration selects; neither imports
scipy. `detectors` are the corner detectors by name, `rate` fits the rotation to the ends of the streaks,
`two_ends` determines the attitudes at both ends of the exposure.
"""
