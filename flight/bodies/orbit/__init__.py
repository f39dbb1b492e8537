"""A satellite in orbit, which rotates freely about three axes and is controlled by its coils only."""
