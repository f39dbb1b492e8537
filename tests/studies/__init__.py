"""What measures rather than checks: campaigns, benches, mutants, pictures."""
