"""Command line of `python -m ground`, which has the same commands as `python -m flight`."""

from flight.__main__ import main

if __name__ == "__main__":
    raise SystemExit(main())
