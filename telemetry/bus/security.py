"""Who may join the bus, and what they may say there.

On the loopback interface the bus is open to this machine. Off it there is only TLS, with certificates on both sides
(`telemetry.keys`), and a router that lets nobody do what is not allowed here. A certificate's common name is its role:

==============  ===================================================  ===============================
role            may say                                              may hear
==============  ===================================================  ===============================
ingest          ``sortie/*/ingest/**``, its history                  who is there
estimate        ``sortie/*/estimate/**``, its history                ingest, its history
record, viewer  their own health and acknowledgements                every stage, its history
==============  ===================================================  ===============================

A router forwards; it needs no rules for itself. Rules hold only where everybody goes through the router: sessions
here are clients, and never talk past it.
"""

from __future__ import annotations

import re
import socket
import ssl
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from telemetry import keys
from telemetry.bus.feed import LARGEST

STAGES = ("ingest", "estimate")
ONLOOKER = "viewer"  # is not waited for long at the end of a stage
READS = {"ingest": (), "estimate": ("ingest",), "record": STAGES, "viewer": (*STAGES, "record")}
QUESTION = 4096  # bytes of a query
_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls)/(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+):(?P<port>\d+)")
_LOOPBACK = re.compile(r"127\.\d+\.\d+\.\d+|localhost|\[::1\]")


def transport(endpoints: Sequence[str], credentials: Path | None, role: str | None, *, listens: bool) -> dict[str, Any]:
    """What a session needs to be let in, after a look at whether it will be.

    Raises
    ------
    ValueError
        If an endpoint is none, leaves this machine in the clear, or asks for a certificate that is not there or not
        good; the text says what to do.
    """
    secure = False
    for endpoint in endpoints:
        found = _ENDPOINT.fullmatch(endpoint)
        if found is None:
            raise ValueError(
                f"{endpoint!r} is no endpoint of the bus: tcp/127.0.0.1:7447 on this machine, tls/HOST:7447 off it"
            )
        if found["protocol"] == "tls":
            secure = True
        elif credentials is not None:
            raise ValueError(f"{endpoint!r} shows no certificate: use tls/{found['host']}:{found['port']}")
        elif not _LOOPBACK.fullmatch(found["host"]):
            raise ValueError(
                f"{endpoint!r} leaves this machine in the clear: use tls/{found['host']}:{found['port']} and "
                f"certificates; sortie keys FOLDER --host {found['host'].strip('[]')} makes them"
            )
    if not secure:
        return {}
    if credentials is None or role is None:
        raise ValueError(
            f"{', '.join(endpoints)}: tls needs certificates and a role; sortie keys FOLDER --host HOST makes them"
        )
    if (why := keys.problem(credentials, role)) is not None:
        raise ValueError(why)
    base, side = "transport/link/tls/", "listen" if listens else "connect"
    return {
        base + "root_ca_certificate": str(credentials / "ca.pem"),
        base + "enable_mtls": True,
        base + "verify_name_on_connect": True,
        base + "close_link_on_expiration": True,
        base + f"{side}_certificate": str(credentials / f"{role}.pem"),
        base + f"{side}_private_key": str(credentials / f"{role}.key"),
    }


def access() -> dict[str, Any]:
    """What a router lets through: nothing but the table of this module, and nothing that is too large."""
    rules: list[dict[str, Any]] = []
    policies = []
    for role in READS:
        own = list(_rules(role))
        rules += own
        policies.append({"id": role, "subjects": [role], "rules": [rule["id"] for rule in own]})
    limits = {"put": LARGEST, "reply": LARGEST + (1 << 16), "query": QUESTION, "delete": QUESTION}
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": role, "cert_common_names": [role]} for role in READS],
            "policies": policies,
        },
        "low_pass_filter": [
            {"id": kind, "flows": ["ingress"], "messages": [kind], "key_exprs": ["**"], "size_limit": size}
            for kind, size in limits.items()
        ],
    }


def _rules(role: str) -> Iterator[dict[str, Any]]:
    """The rules of one role; ingress is what comes from it, egress what goes to it."""
    writes, reads = role in STAGES, READS[role]
    said = [f"sortie/*/{role}/**"] if writes else [f"sortie/*/{role}/0/event/health"]
    answered = [f"sortie/*/ack/{role}/**", *([f"sortie/*/history/{role}/**"] if writes else [])]
    heard = [f"sortie/*/{stage}/**" for stage in reads]
    asked = [f"sortie/*/history/{stage}/**" for stage in reads] + ([f"sortie/*/ack/*/{role}"] if writes else [])
    present = [f"sortie/*/listening/*/{role}/**", *([f"sortie/*/alive/*/{role}/*/*"] if writes else [])]
    # Who is there is no secret among those that were let in, and only interest in it is said with wildcards.
    anybody = ["sortie/*/alive/**", "sortie/*/listening/**"]
    for flow, messages, where in (
        ("ingress", ["put"], [*said, f"sortie/*/ack/{role}/**"]),
        ("ingress", ["declare_queryable", "reply"], answered),
        ("ingress", ["liveliness_token"], present),
        ("ingress", ["declare_subscriber"], [*heard, *([f"sortie/*/ack/*/{role}"] if writes else [])]),
        ("ingress", ["query"], asked),
        ("ingress", ["declare_liveliness_subscriber", "liveliness_query"], anybody),
        ("egress", ["put"], [*heard, *([f"sortie/*/ack/*/{role}"] if writes else [])]),
        ("egress", ["declare_queryable", "reply"], asked),
        ("egress", ["liveliness_token"], anybody),
        ("egress", ["declare_subscriber"], [*said, "sortie/*/ack/**"]),
        ("egress", ["query"], ["sortie/*/ack/**", *answered]),
        ("egress", ["declare_liveliness_subscriber", "liveliness_query"], anybody),
    ):
        if where:
            yield {
                "id": f"{role} {flow} {messages[0]}",
                "permission": "allow",
                "flows": [flow],
                "messages": messages,
                "key_exprs": where,
            }


def refusal(endpoint: str, credentials: Path | None, role: str | None) -> str | None:
    """Why somebody who is there does not let us in, as far as that can be known; None if nobody is there, or nothing
    is wrong.
    """
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None:
        return None
    host, port = found["host"].strip("[]"), int(found["port"])
    try:
        with socket.create_connection((host, port), timeout=2.0) as plain:
            if found["protocol"] == "tcp":
                return _greeting(plain, endpoint)
            if credentials is None or role is None:
                return None
            context = ssl.create_default_context(cafile=credentials / "ca.pem")
            context.load_cert_chain(credentials / f"{role}.pem", credentials / f"{role}.key")
            with context.wrap_socket(plain, server_hostname=host) as secured:
                secured.settimeout(0.5)  # a certificate is refused after the handshake
                secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"{endpoint}: the router's certificate is not good: {error.verify_message}"
    except ssl.SSLEOFError:  # it may be starting, or ending
        return None
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        return f"{endpoint}: the router refuses the certificate of {role}, or is none with certificates: {reason}"
    except OSError:
        return None
    return None


def _greeting(plain: socket.socket, endpoint: str) -> str | None:
    """A server that speaks TLS answers what is no TLS with an alert (record type 21)."""
    plain.settimeout(0.5)
    try:
        plain.sendall(b"\x00" * 16)
        answer = plain.recv(8)
    except OSError:
        return None
    if answer[:2] == b"\x15\x03":
        return f"{endpoint}: what listens there wants certificates: use tls/ and --credentials FOLDER"
    return None
