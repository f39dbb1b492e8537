"""Drivers: each knows one part's registers or packets, and speaks over a bus Protocol."""
