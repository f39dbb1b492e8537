"""`python -S -E -m hal.guardian`: the guardian's process."""

import sys

from hal.guardian.process import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
