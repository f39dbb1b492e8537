"""What the rate groups do: each task owns one concern of the loop."""
