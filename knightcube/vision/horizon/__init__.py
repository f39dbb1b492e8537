"""Nadir from images of the Earth's limb (Meller et al., chapter 3, and beyond).

    solution = find_nadir(image, camera, HorizonKnowledge(position=..., sun=..., attitude=...))

`nadir` finds the nadir in one image, or in the images of several cameras. It finds `edges` on scan lines,
groups them into cones (`initial_guess`), fits the limb to each group (`limb`) and tests the fit against the
prior knowledge and the brightness of the whole image (`hypothesis`, `illumination`). If no image shows a
limb, `illumination.coarse_nadir` gives a coarse nadir. The methods of the paper are in
`knightcube.reference.horizon`.
"""
