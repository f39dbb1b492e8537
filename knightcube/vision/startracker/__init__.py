"""The star tracker: identifies the stars of a frame and determines its attitude (Michalski chapter 3).

`detection` finds and measures stars. `lost_in_space` and `verification` identify them with the guide stars of
`index`, without and with a prior attitude; `attitude_fit` fits the attitude to the identified directions.
`image_fit` determines the attitude from the positions in the image. `solve` combines these steps, and
`catalogue_refit` refits the streaks of an identified frame. `sky_map` converts between pixels and directions.
"""
