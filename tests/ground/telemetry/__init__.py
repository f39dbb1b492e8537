"""A flight watched in the terminal."""
