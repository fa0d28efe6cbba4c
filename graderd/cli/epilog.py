"""The example at the end of each command's help."""

from __future__ import annotations


def example(*lines: str) -> str:
    """Examples for a command's help, one a line; blank lines keep the help from joining them."""
    return "\n\n".join(["Example:" if len(lines) == 1 else "Examples:", *lines])
