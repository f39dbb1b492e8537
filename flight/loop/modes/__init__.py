"""The modes of the satellite and their transitions."""
