"""What must outlive the process: boots, unclean shutdowns, what was learned, the last mode."""
