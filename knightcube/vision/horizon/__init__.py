"""Nadir from pictures of the Earth's limb (Meller et al., chapter 3, and beyond).

    solution = find_nadir(frame, camera, HorizonKnowledge(position=..., sun=..., attitude=...))

`nadir` is the default method and decides: `edges` on scan lines, `consensus` on cones; each cone makes a
`hypothesis`, fitted (`limb_equation`, `limb_fit`, `profile_fit`) and tested against prior knowledge
(`azimuth`, `illumination`). `several_cameras` fits one limb to the pictures of all, `cameras` says which to
read first, `filled_camera` gives a coarse nadir where no limb is in view. The paper's own:
`binary_edges`, `vector_method`, and those of `knightcube.reference.horizon`.
"""
