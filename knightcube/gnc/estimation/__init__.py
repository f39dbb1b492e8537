"""Measurements in, one state estimate with its covariance out."""
