"""Control about one axis: the LQ tracker, and manoeuvres that excite the plant (Sease 2013, chapter 5)."""
