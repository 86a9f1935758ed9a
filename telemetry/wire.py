"""Messages on the wire: MessagePack, versioned; an array is ``[dtype, shape, little-endian bytes]``::

    {"vehicle": 1, "source": "0/1", "boot": 0, "sequence": 17, "t": ["<i8", [3], b"..."], "t_rx": [...], ...}

under the encoding ``application/msgpack;sortie.<Kind>.v1``. What does not fit is refused.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from telemetry.messages import KINDS, Message

VERSION = 1


class Array(NamedTuple):
    """An array on the wire."""

    dtype: str
    shape: tuple[int, ...]
    data: bytes


_DTYPES = {"<f8", "<i8"}


def _write_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        little = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        return Array(little.dtype.str, little.shape, little.tobytes())
    raise NotImplementedError(f"a message cannot carry a {type(value).__name__}")


def _read_array(kind: Any, value: Any) -> NDArray[Any]:
    dtype, shape, data = msgspec.convert(value, Array)
    if dtype not in _DTYPES:
        raise ValueError(f"array of {dtype!r}: a message carries only {', '.join(sorted(_DTYPES))}")
    wanted = kind.__args__[1].__args__[0]
    if np.dtype(dtype) != np.dtype(wanted):
        raise ValueError(f"array of {dtype!r} where {np.dtype(wanted).str!r} belongs")
    if len(shape) not in (1, 2) or min(shape) < 0 or shape[0] * (shape[1] if len(shape) == 2 else 1) * 8 != len(data):
        raise ValueError(f"array of shape {tuple(shape)} in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape)


_encoder = msgspec.msgpack.Encoder(enc_hook=_write_array)
_decoders = {name: msgspec.msgpack.Decoder(kind, dec_hook=_read_array) for name, kind in KINDS.items()}


def schema(kind: type[Message]) -> str:
    """Name of a kind and its version on the wire, e.g. ``sortie.Imu.v1``."""
    return f"sortie.{kind.__name__}.v{VERSION}"


def encode(message: Message) -> bytes:
    """Turn a message into MessagePack bytes (its schema travels beside them)."""
    return _encoder.encode(message)


def decode(schema: str, payload: bytes) -> Message:
    """Turn bytes from the wire into a message.

    Raises
    ------
    ValueError
        If the schema is not one of this version's, or the payload does not fit it; the text says which.
    """
    name = schema.removeprefix("sortie.").removesuffix(f".v{VERSION}")
    if schema != f"sortie.{name}.v{VERSION}" or name not in _decoders:
        raise ValueError(f"unknown message {schema!r}: this version reads sortie.<Kind>.v{VERSION}")
    try:
        return _decoders[name].decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{schema}: {error}") from None
