"""What the satellite is doing, and what makes it do something else."""
