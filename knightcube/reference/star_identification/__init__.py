"""The classical methods of star identification (Michalski 3.2), each as its source describes it.

Each method of `methods` proposes candidates from the pairs, triangles or grid patterns of `known_sky`.
`search` compares them with the field, and `knightcube.vision.startracker.verification` accepts
or rejects them.
"""
