"""The star tracker: identifies the stars of a frame and determines its attitude (Michalski chapter 3).

    pixels -> detection -> StarField -> identification -> verification -> attitude

`detection` finds and measures stars, `identification` names them with the guide stars of `index`, and
`image_fit` determines the attitude from their positions. `solve` combines these steps into a `solution`.
"""
