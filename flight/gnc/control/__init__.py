"""Control: from the state and the path to a coil current."""
