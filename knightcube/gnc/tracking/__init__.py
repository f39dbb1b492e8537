"""Tracking of objects by the directions in which a camera sees them: bearings only."""
