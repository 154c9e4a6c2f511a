"""Overrides for Hydra whose values may be any text."""

from __future__ import annotations

import re


def override(key: str, text: object) -> str:
    """An override that gives a dotted key a text as it is, such as a path, whatever it has of Hydra's grammar."""
    # Within quotes Hydra reads a backslash as itself, but for those before a quote.
    quoted = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), str(text))
    return f"{key}='{quoted.replace('${', chr(92) + '${')}'"
