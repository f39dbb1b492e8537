"""The star tracker: identifies the stars of a frame and determines its attitude (Michalski chapter 3).

    pixels -> detection -> StarField -> an identification method -> verification -> attitude

`field` is the input of an identification method, `identification` its result; `guide_stars` is the catalogue.
"""
