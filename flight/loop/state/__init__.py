"""State that outlives the process: boot count, unclean shutdowns, learned parameters, the last mode."""
