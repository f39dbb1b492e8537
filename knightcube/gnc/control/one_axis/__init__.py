"""Control about one axis: LQ tracker, PID, adaptive control (Sease 2013, chapter 5)."""
