"""What a solved picture is asked: world coordinates for other programs, Sun, Moon and planets in it."""
