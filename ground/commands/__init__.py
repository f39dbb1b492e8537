"""The commands of the ground, one module each; `python -m flight` finds this table by its entry point."""

COMMANDS = {
    "command": "tell a flight what to do",
    "report": "tell what a run achieved",
    "export": "write a run's packets as CSV",
    "plan": "plan a single path",
    "identify": "the body's constants from a short flight",
    "rate": "body rate from a picture of streaked stars",
    "solve": "where a picture of the sky looks, and which stars it shows",
    "camera": "take frames from the configured camera and look at them",
    "horizon": "the way down, from a picture of the Earth's limb",
    "calibrate": "a camera's lens from pictures of the sky",
}
