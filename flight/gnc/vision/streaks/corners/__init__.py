"""The thesis's way from a frame to a rate: corner detectors find the streaks' endpoints (Sease chapter 3)."""
