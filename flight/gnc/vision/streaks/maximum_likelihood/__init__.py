"""Maximum-likelihood streaks: one rotation and all stars fitted to all pixels of one exposure."""
