"""Resident space objects among the streaks of one frame (Sease chapter 4).

`detect` composes: `rso_indicators` (which streaks do not move as the stars do), `short_regions` (points),
`judge` (whether stars explain the pixels: `star_light`; with the stars removed: `merged`), `report`.

`sight` gives directions among the stars of what may be objects, in frames of streaks or points (`sighted`).
"""
