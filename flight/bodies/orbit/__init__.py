"""A satellite in orbit: free in three axes, turned by its coils alone."""
