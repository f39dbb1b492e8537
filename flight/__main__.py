"""`python -m flight`, and the console script `knightcube`, which is the same."""

import os
import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C ends a command at once, imports too, without a traceback. A flight takes the signal over.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

# Matrices here are small: multithreaded BLAS would slow them down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from flight.app.cli import main

__all__ = ["main"]

if __name__ == "__main__":
    raise SystemExit(main())
