"""The classical methods of star identification (Michalski 3.2), each as its source describes it.

Each proposes candidates from pairs, triangles or grids of the stars of `known_sky`; `search`
compares them with the field, and `knightcube.vision.startracker.identification.verification` accepts or
rejects them. `methods` lists them by name.
"""
