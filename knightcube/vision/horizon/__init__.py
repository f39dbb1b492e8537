"""Nadir from images of the Earth's limb (Meller et al., chapter 3, and beyond).

    solution = find_nadir(frame, camera, HorizonKnowledge(position=..., sun=..., attitude=...))

`nadir.find_nadir` is the default method. It finds `edges` on scan lines, groups them into cones
(`initial_guess`), fits the limb to each group (`limb_fit`, `limb_profile`) and tests the fit against the
prior knowledge and the brightness of the whole image (`hypothesis`, `illumination`). `several_cameras` fits
one limb to the images of all cameras. `illumination.coarse_nadir` gives a coarse nadir if no image shows a
limb. The methods of the paper are in `knightcube.reference.horizon`.
"""
