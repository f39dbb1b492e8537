"""The star tracker: identifies the stars of a frame and determines its attitude (Michalski, chapter 3).

`survey` finds the areas of a frame above the noise and decides whether the frame shows points or streaks
(`knightcube.vision.streaks` measures streaks). `detect` finds stars in a whole frame, or only near predicted
positions. `psf_fit` fits the point spread function, with which `measurement` measures positions and fluxes.
`lost_in_space` identifies the stars without a prior attitude, and `verification` with a prior attitude, by
comparison with the guide stars in the sky index (`index`). `attitude_fit` fits the attitude to the directions
of identified stars, and `image_fit` fits it to their positions in the image. `solve` combines detection,
identification and attitude fit. `catalogue_refit` repeats the fit of the streaks of an identified frame with
all stars of the catalogue. `sky_map` converts between pixels and directions.
"""
