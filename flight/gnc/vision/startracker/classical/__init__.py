"""The classical methods of star identification (Michalski 3.2), each as its source describes it.

Each makes candidates in its own way, from pairs, triangles or grids of the stars of `known_sky`; `search`
lays them over the field and lets `flight.gnc.vision.startracker.identification.verification` believe or
refuse. `methods` has them by name.
"""
