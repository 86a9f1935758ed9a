"""Everything into one recording, and back out of it for review; knows Rerun, and of the project only the vocabulary."""

from __future__ import annotations

import os

_LOG = "RUST_LOG"


def load() -> None:
    """Import the SDK without its advice against files that have no index: a live recording gets its index at the end.

    What it shall say is read from the environment when it is first imported, and at no other time.
    """
    if _LOG in os.environ:  # somebody wants to hear more, or less
        return
    os.environ[_LOG] = "warn,re_log_encoding::rrd::file_sink=error"
    try:
        import rerun  # noqa: F401
    finally:
        del os.environ[_LOG]
