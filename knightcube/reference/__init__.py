"""Published methods that the flight does not use, for comparison with the methods in use."""
