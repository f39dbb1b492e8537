"""The star tracker: which stars a frame shows, and so where the camera looks (Michalski chapter 3).

    pixels -> detection -> StarField -> an identification method -> verification -> attitude

`field` and `identification` hold what travels between the rooms, `guide_stars` the stars that one knows.
"""
