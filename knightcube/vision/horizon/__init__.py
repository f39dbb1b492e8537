"""Nadir from images of the Earth's limb, by methods that extend Meller et al., chapter 3.

    solution = find_nadir(image, camera, HorizonKnowledge(position=..., sun=..., attitude=...))

`nadir` finds the nadir in one image, or in the images of several cameras. For each image, `nadir` finds edges
on scan lines (`edges`), groups the edges into cones (`initial_guess`), fits a limb to each group (`limb`) and
tests the fit against prior knowledge and the brightness of the whole image (`hypothesis`, `illumination`). If
no image shows a limb of the Earth, `illumination.coarse_nadir` gives a coarse nadir. The methods of Meller et
al. are in `knightcube.reference.horizon`.
"""
