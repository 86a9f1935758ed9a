"""What the user is told, in words."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from telemetry.messages import Message

TOLD = (  # of a window: state, factor, unit for people
    ("north", 1.0, "m"),
    ("altitude", 1.0, "m"),
    ("velocity_north", 1.0, "m/s"),
    ("h", 1.0, "m"),
    ("u", 1.0, "m/s"),
    ("w", 1.0, "m/s"),
    ("theta", 57.29578, "deg"),
    ("phi", 57.29578, "deg"),
)


class Failure(Exception):
    """The work failed, for a reason that one line can tell."""


def say(text: str) -> None:
    """Tell the user something that is not the result; where nobody can hear it any more, the work goes on."""
    try:
        print(text, file=sys.stderr, flush=True)
    except (OSError, ValueError):  # the terminal is gone, a pipe was closed: what waits for it would fail again
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)


def counted(number: int, what: str) -> str:
    """A number of things, in words."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def watch(
    messages: Iterable[Message], tell: Callable[[str], None], *, every: bool = True, since: int = 0
) -> Iterator[Message]:
    """Pass messages on and say what an engineer would look up for; unless `every`, only warnings and test points.

    Nothing is said of what was received up to `since`, ns: it was said then.
    """
    import numpy as np

    from telemetry.messages import Event, Report, Window

    for message in messages:
        if message.t_rx[-1] <= since:
            pass
        elif isinstance(message, Event):
            for t, level, text in zip(message.t.tolist(), message.level, message.text, strict=True):
                if every or level != "info":
                    tell(f"{_clock(t)} {text}" if level == "info" else f"{_clock(t)} {level}: {text}")
        elif isinstance(message, Window) and (every or message.test_point):
            name = f"test point {message.test_point}" if message.test_point else f"window {message.number}"
            told = [(what, scale, unit) for what, scale, unit in TOLD if what in message.names]
            sigma = ", ".join(
                f"{what} {np.nanmedian(message.std[:, message.names.index(what)]) * scale:.2g} {unit}"
                for what, scale, unit in told
            )
            seconds = (message.t[-1] - message.t[0]) * 1e-9
            model = message.model.replace("_", " ")
            tell(
                f"{_clock(int(message.t[-1]))} {name}, {model}, {seconds:.1f} s, closed by {message.reason}; "
                f"sigma: {sigma}"
            )
        elif isinstance(message, Report) and message.alarms:
            name = f"test point {message.test_point}" if message.test_point else message.scope
            tell(f"{_clock(int(message.t[-1]))} ALARM: {name}: {'; '.join(message.alarms)}")
        yield message


def _clock(t: int) -> str:
    return datetime.fromtimestamp(t // 1_000_000_000, UTC).strftime("%H:%M:%S")
