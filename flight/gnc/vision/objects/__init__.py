"""Resident space objects among the streaks of one frame (Sease chapter 4)."""
