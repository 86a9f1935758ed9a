"""A session: what a process says to the others, and hears of them."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import zenoh

from telemetry.bus import security
from telemetry.bus.ancestry import Lineage
from telemetry.bus.feed import LARGEST
from telemetry.bus.publisher import DRAIN, Publisher
from telemetry.bus.subscription import Subscription

HISTORY = 8 << 30
EMBEDDED_HISTORY = 64 << 20
BLOCK = 5.0


def chunk(text: str) -> str:
    """User text as one chunk of a key: what zenoh gives a meaning to becomes ``_``."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text) or "_"


def settings(
    mode: str, listen: Sequence[str] = (), connect: Sequence[str] = (), *, block: float = BLOCK
) -> dict[str, Any]:
    """The configuration of a zenoh session in which nothing is scouted, and nothing listens unless it is named."""
    return {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/timeout_ms": 500,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
        # A consumer that stalls for longer loses its link, opens it again, and reads the history.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(block * 1e6),
        "transport/link/rx/max_message_size": LARGEST + (1 << 20),
    }


def open_session(items: Mapping[str, Any]) -> zenoh.Session:
    """Open a zenoh session.

    Raises
    ------
    zenoh.ZError
        If it cannot be.
    """
    zenoh.init_log_from_env_or("off")  # what fails is raised, with a reason
    config = zenoh.Config()
    for key, value in items.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Bus:
    """A session.

    Parameters
    ----------
    sortie : str
        Name of the sortie, part of every key.
    listen : sequence of str
        Endpoints to accept other processes on, e.g. ``tcp/127.0.0.1:7447`` or ``tls/10.0.0.1:7447``. The session is
        then the router of the sortie.
    connect : sequence of str
        Endpoints of a router to join. With neither, the session has no network at all.
    wait : float, optional
        How long to wait for the router, s; for ever if not given.
    credentials : Path, optional
        Folder with the certificates of `telemetry.keys`; ``tls/`` needs it.
    role : str, optional
        Whose certificate to show: "router", "ingest", "estimate", "record" or "viewer". Who listens is by default the
        router.
    block : float
        How long a consumer that takes nothing may hold up who publishes, s, before it loses its link. It opens it
        again, and loses nothing, because the history fills the gap.
    history : int, optional
        Bytes on disk that each stage of this session may fill with what it has said.
    namespace : str, optional
        Put before every key: sessions in different namespaces are invisible to each other.

    Attributes
    ----------
    root : str
        What every key begins with.
    networked : bool
        Whether there is anybody outside this process.

    Raises
    ------
    ValueError
        If an endpoint would leave this machine in the clear, or asks for a certificate that is not there or not good.
    OSError
        If it cannot listen, e.g. because the port is in use, or the router did not come or did not let us in.
    """

    def __init__(
        self,
        sortie: str,
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        wait: float | None = None,
        credentials: Path | None = None,
        role: str | None = None,
        block: float = BLOCK,
        history: int | None = None,
        namespace: str | None = None,
    ) -> None:
        self.root = f"sortie/{chunk(sortie)}"
        self.networked = bool(listen or connect)
        self.history = history if history is not None else HISTORY if self.networked else EMBEDDED_HISTORY
        self._client = bool(connect) and not listen
        mode = "router" if listen else "client" if connect else "peer"
        role = role or ("router" if listen else None)
        items = settings(mode, listen, connect, block=block)
        items |= security.transport((*listen, *connect), credentials, role, listens=bool(listen))
        if credentials is not None:
            items["connect/timeout_ms"] = 2000  # a handshake over a slow link
        if listen and credentials is not None:
            items |= security.access()
        if namespace is not None:
            items["namespace"] = namespace
        end = None if wait is None else time.monotonic() + wait
        while True:  # rather than inside zenoh, where nothing could interrupt the wait
            try:
                self.session = open_session(items)
                return
            except zenoh.ZError as error:
                if listen:
                    raise OSError(
                        f"cannot open the bus on {', '.join(listen)}: the port is in use, or not ours to use "
                        f"({str(error).split(' at ')[0]})"
                    ) from None
                refusals = [security.refusal(endpoint, credentials, role) for endpoint in connect]
                if all(refusal is not None for refusal in refusals):  # somebody is there, and waiting changes nothing
                    raise OSError("; ".join(str(refusal) for refusal in refusals)) from None
                if end is not None and time.monotonic() > end:
                    raise OSError(
                        f"nobody carries the bus on {', '.join(connect)}: start sortie ingest or sortie router there "
                        "first"
                    ) from None

    def publisher(self, stage: str, lineage: Lineage | None = None) -> Publisher:
        """The output of a stage, made from these runs of other stages."""
        return Publisher(self, stage, lineage)

    def subscribe(
        self, service: str, stages: Sequence[str], *, health: bool = False, stale: float = 1.0
    ) -> Subscription:
        """Everything that `stages` say, for a consumer named `service`.

        Parameters
        ----------
        service : str
        stages : sequence of str
        health : bool
            Also hand on `Health`, of this consumer and of what it listens to. It stands outside the numbered output of
            the stages, so that nothing deterministic should ask for it.
        stale : float
            Age of data that raises an alarm, s.
        """
        return Subscription(self, service, stages, health=health, stale=stale)

    @staticmethod
    def chunk(text: str) -> str:
        """`chunk`."""
        return chunk(text)

    @property
    def is_client(self) -> bool:
        """Whether it joined a router."""
        return self._client

    @property
    def connected(self) -> bool:
        """False while a client has lost its router."""
        return not self._client or bool(self.session.info.routers_zid())

    def token(self, kind: str, *chunks: str) -> Any:
        """Show that something is there, until the token is undeclared or the process is gone."""
        return self.session.liveliness().declare_token(
            "/".join((self.root, kind, str(self.session.info.zid()), *chunks))
        )

    def tokens(self, pattern: str) -> list[list[str]]:
        """Who is there: kind, session and what follows."""
        replies = self.session.liveliness().get(f"{self.root}/{pattern}", timeout=1.0)
        return [str(reply.ok.key_expr).removeprefix(f"{self.root}/").split("/") for reply in replies if reply.ok]

    def linger(self, deadline: float = DRAIN) -> bool:
        """Wait until no other session publishes or listens any more, so that whoever carries the bus leaves last.

        Returns
        -------
        bool
            False when one still did after `deadline` seconds.
        """
        end = time.monotonic() + deadline
        own = str(self.session.info.zid())
        while any(session != own for kind in ("alive", "listening") for _, session, *_ in self.tokens(f"{kind}/**")):
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

    def close(self) -> None:
        """Close the session; what is still on the way may be lost, so publishers `finish` first."""
        self.session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
