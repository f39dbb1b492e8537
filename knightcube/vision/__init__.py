"""What the cameras show: streaks, objects, stars, the horizon and the Sun."""
