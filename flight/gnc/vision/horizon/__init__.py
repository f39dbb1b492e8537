"""Nadir from pictures of the Earth's limb (Meller et al., chapter 3) and past it.

    solution = find_nadir(frame, camera, HorizonKnowledge(position=..., sun=..., attitude=...))

`nadir` is the default method and its judgement: `edges` on scan lines, `consensus` on cones, each cone a
`hypothesis` that is fitted (`limb_equation`, `limb_fit`, `profile_fit`) and held against what is known
(`azimuth`, `illumination`). The paper's own: `binary_edges`, `circle`, `graphic_method`, `vector_method`.
"""
