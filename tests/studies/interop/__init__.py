"""What ground software of other authors reads of a run, against our own reader."""
