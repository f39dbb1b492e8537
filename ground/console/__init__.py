"""A flight in the browser: the same page shows a live flight and the replay of a run."""
