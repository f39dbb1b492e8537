"""Control about one axis: PID and adaptive control (Sease 2013, chapter 5)."""
