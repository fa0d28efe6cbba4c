"""Text from outside, made fit to be shown: in the log, in the status, on a terminal."""

from __future__ import annotations

import re

_UNSAFE_IN_JSON = re.compile("[\x7f-\x9f\u00ad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]")


def printable(text: str) -> str:
    """``text`` on one line, with every character that does not print (line ends, escape sequences, marks that turn the
    direction of writing) shown by its number, as in ``\\x1b``. What is printable already comes back as it is, so that
    doing it twice changes nothing."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def terminal_safe_json(text: str) -> str:
    """JSON ``text`` of the same meaning that a terminal may be shown: JSON itself escapes only the control characters
    below 32."""
    return _UNSAFE_IN_JSON.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
