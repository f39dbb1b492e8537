"""The testbed: a body on a thread in a fixed field, turned about one axis."""
