"""Two-line elements of a satellite in a polar orbit of 500 km, with correct checksums."""

POLAR_ORBIT = (
    "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000-0 0  9993",
    "2 99999  97.4100 340.0000 0010000   0.0000   0.0000 15.21000000    16",
)


def summed(line: str) -> str:
    """Return a line whose last column is its checksum."""
    return line[:68] + str(sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10)
