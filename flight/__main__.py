"""The entry point of `python -m flight` and of the equivalent console script `knightcube`."""

import os
import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C ends a command at once and without a traceback, even during imports. The code that runs a flight
    # installs its own signal handler later.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

# Multithreaded BLAS would slow the computation down, because all matrices are small.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from flight.app.cli import main

__all__ = ["main"]

if __name__ == "__main__":
    raise SystemExit(main())
