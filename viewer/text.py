"""Text: times and lengths of time as a human reads them."""

from __future__ import annotations

import numpy as np


def utc(t: int, *, date: bool = True) -> str:
    """A Unix time in ns as text, to a tenth of a second."""
    text = str(np.datetime64(t // 100_000_000 * 100, "ms"))[:-2].replace("T", " ")
    return text if date else text[11:]


def duration(seconds: float) -> str:
    """A length of time for humans, e.g. ``3 min 12 s``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
