"""The Earth around a satellite: figure, orientation, Sun, shadow, geomagnetic field, orbit."""
