"""Images from the satellite's cameras: star streaks, objects, stars, the horizon and the Sun."""
