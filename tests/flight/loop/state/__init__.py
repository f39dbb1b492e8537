"""Tests of the state that outlives the process."""
