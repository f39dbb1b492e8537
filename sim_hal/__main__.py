"""`python -m sim_hal`: the emulated devices, for anybody's software."""

from sim_hal.serving.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
