"""Peers that the environment of the tests cannot hold: each in an environment of its own, made by ``make peers``."""
