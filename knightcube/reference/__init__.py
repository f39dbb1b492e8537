"""Methods of the source publications that are not used in flight, for comparison with the methods in use."""
