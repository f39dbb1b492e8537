"""Published methods that the flight software does not use, for comparison with the methods in use."""
