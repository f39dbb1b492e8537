"""`python -m flight`, and the console script `knightcube`, which is the same."""

import os

# Matrices here are small: a BLAS that starts a thread a core only makes them wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from flight.app.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
