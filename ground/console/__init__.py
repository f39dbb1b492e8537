"""Browser console of a flight, which shows a live flight or the replay of a run on the same page."""
