"""Draws the house from the code itself: rooms, floors, arrows, sizes, and the lines that a flight reaches."""
