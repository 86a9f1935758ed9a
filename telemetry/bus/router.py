"""A router: what carries the bus of a sortie between machines, when no stage shall."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zenoh

from telemetry.bus import security
from telemetry.bus.session import open_session, settings


def router_config(listen: Sequence[str], credentials: Path | None = None) -> dict[str, Any]:
    """The configuration of a router: paths of settings and their values.

    Parameters
    ----------
    listen : sequence of str
        Endpoints; with certificates the access rules of `telemetry.bus.security` hold.
    credentials : Path, optional
        Folder of `telemetry.keys`.

    Raises
    ------
    ValueError
        As `telemetry.bus.Bus`.
    """
    if not listen:
        raise ValueError("a router listens somewhere: name an endpoint, e.g. tls/10.0.0.1:7447")
    items = settings("router", listen)
    items |= security.transport(listen, credentials and credentials.resolve(), "router", listens=True)
    if credentials is not None:
        items |= security.access()
    return items


def router_file(listen: Sequence[str], credentials: Path | None = None) -> str:
    """The same for any zenohd: the text of a file for ``zenohd -c FILE``."""
    nested: dict[str, Any] = {}
    for path, value in router_config(listen, credentials).items():
        *folders, name = path.split("/")
        place = nested
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value
    return json.dumps(nested, indent=2) + "\n"


def serve_router(
    listen: Sequence[str],
    credentials: Path | None = None,
    *,
    stop: threading.Event | None = None,
    ready: Callable[[], object] | None = None,
) -> None:
    """Carry the bus until told to stop.

    Parameters
    ----------
    listen, credentials
        As in `router_config`.
    stop : threading.Event, optional
        Ends it when set; else an interrupt does.
    ready : callable, optional
        Called when it listens.

    Raises
    ------
    ValueError
        As `router_config`.
    OSError
        If it cannot listen.
    """
    try:
        session = open_session(router_config(listen, credentials))
    except zenoh.ZError as error:
        raise OSError(
            f"cannot carry the bus on {', '.join(listen)}: the port is in use, or not ours to use "
            f"({str(error).split(' at ')[0]})"
        ) from None
    try:
        if ready is not None:
            ready()
        (stop or threading.Event()).wait()
    finally:
        session.close()  # type: ignore[no-untyped-call]
