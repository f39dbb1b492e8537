"""`python -m flight`, and the console script `knightcube`, which is the same."""

import os

# Matrices here are small: multithreaded BLAS would slow them down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from flight.app.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
