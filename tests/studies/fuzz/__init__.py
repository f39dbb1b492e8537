"""Fuzzing: mutated inputs through every door that bytes and texts come in by.

A target makes an input from a generator, feeds it, and raises `Finding` for accepted corruption. Any other
exception is a crash, more than `LIMIT_S` of CPU a hang. Input number i of seed s is the same for ever.
"""
