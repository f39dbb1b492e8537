"""What measures rather than checks: campaigns, benches, fuzzers, pictures."""
