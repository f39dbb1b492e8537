"""Tools for people on the ground: reports, exports, calibration, identification and pictures.

No module of this package runs on board a satellite.
"""
