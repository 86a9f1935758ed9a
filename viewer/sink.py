"""Sink: one Rerun recording on disk, fed by columns; the only place where the SDK's traps are handled."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from telemetry.messages import Floats, Times

APPLICATION = "sortie"


def claim(path: Path) -> None:
    """Create a file that does not exist yet.

    Raises
    ------
    FileExistsError
        If it exists: opening it would overwrite a flight.
    OSError
        If the folder does not exist or cannot be written.
    """
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644))
    except FileExistsError:
        raise FileExistsError(
            f"{path} exists and a recording is never overwritten: give another name or move it away"
        ) from None
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}: create it or give another place") from None
    except PermissionError:
        raise PermissionError(f"{path}: no permission to write in {path.parent}: give another place") from None
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or error}") from None


def stamps(t: Times, t_rx: Times, window: int | None = None) -> list[rr.TimeColumn]:
    """Time columns of rows; integers would be read as seconds, hence the datetime type."""
    columns = [
        rr.TimeColumn("t_vehicle", timestamp=t.astype("datetime64[ns]")),
        rr.TimeColumn("t_rx", timestamp=t_rx.astype("datetime64[ns]")),
    ]
    if window is not None:
        columns.append(rr.TimeColumn("window", sequence=np.full(len(t), window, np.int64)))
    return columns


class Column(NamedTuple):
    """A component's rows, as they are sent."""

    descriptor: Any
    rows: pa.Array

    def component_descriptor(self) -> Any:
        """Which component it is."""
        return self.descriptor

    def as_arrow_array(self) -> pa.Array:
        """One list for each row."""
        return self.rows


def numbers(descriptors: tuple[Any, ...], *values: Floats) -> list[Column]:
    """Columns of plain numbers, (k,) or (k, m) each: what the archetypes' own `columns` make, at a tenth of the cost,
    which matters when every entity has some a second.
    """
    columns = []
    for descriptor, value in zip(descriptors, values, strict=True):
        flat = np.ascontiguousarray(value, np.float64)
        width = 1 if flat.ndim == 1 else flat.shape[1]
        offsets = np.arange(0, flat.size + 1, width, dtype=np.int32)
        columns.append(Column(descriptor, pa.ListArray.from_arrays(pa.array(offsets), pa.array(flat.ravel()))))
    return columns


def _descriptors(columns: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(column.component_descriptor() for column in columns)


_SCALARS = _descriptors(rr.Scalars.columns(scalars=[0.0]))
_MEASUREMENTS = _descriptors(rr.Measurements.columns(values=[0.0], variances=[0.0]))


class Sink:
    """A recording that is being written.

    Parameters
    ----------
    path : Path
        Claimed file.
    sortie : str
        Recording id and name; a second sink of the same sortie is a layer of the first.
    on_alarm : callable
        Told once when writing begins to fail, and once when it works again.
    serve : int, optional
        Port on 127.0.0.1 at which viewers may look on; None for none.
    join : int, optional
        Port on 127.0.0.1 of another sink of this sortie whose viewers shall see this layer too.
    index : bool
        Whether the file ends with a list of everything in it. It is kept in memory until then, and grows by two
        kilobytes with every chunk; readers do without.
    """

    def __init__(
        self,
        path: Path,
        sortie: str,
        on_alarm: Callable[[str], None],
        *,
        serve: int | None = None,
        join: int | None = None,
        index: bool = True,
    ) -> None:
        self.path = path
        self.entities: set[str] = set()
        self.failing = False
        self._on_alarm = on_alarm
        self._stamped: tuple[Any, Any, int | None, list[rr.TimeColumn]] | None = None  # times, and their columns
        self._stream = rr.RecordingStream(APPLICATION, recording_id=sortie, send_properties=False)
        # A clock of this machine in every row would make equal flights into different recordings.
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        file = rr.FileSink(str(path), write_footer=index)
        if serve is not None:
            self._stream.set_sinks(file, rr.GrpcServerSink(bind_ip="127.0.0.1", port=serve))
        elif join is not None:
            self._stream.set_sinks(file, rr.GrpcSink(f"rerun+http://127.0.0.1:{join}/proxy"))
        else:
            self._stream.set_sinks(file)
        self._stream.send_recording_name(sortie)

    def scalars(self, entity: str, t: Times, t_rx: Times, values: Floats, window: int | None = None) -> None:
        """Rows of one or several plain numbers; values of shape (k,) or (k, m)."""
        self._columns(entity, self._stamps(t, t_rx, window), numbers(_SCALARS, values))

    def measurements(
        self, entity: str, t: Times, t_rx: Times, values: Floats, variances: Floats, window: int | None = None
    ) -> None:
        """Rows of a number with its variance."""
        self._columns(entity, self._stamps(t, t_rx, window), numbers(_MEASUREMENTS, values, variances))

    def points(self, entity: str, t: Times, t_rx: Times, positions: list[Floats]) -> None:
        """Rows of points in local metres, east-north-up."""
        columns = rr.Points3D.columns(positions=np.concatenate(positions).astype(np.float32))
        self._columns(entity, stamps(t, t_rx), columns.partition([len(row) for row in positions]))

    def lines(self, entity: str, t: Times, t_rx: Times, strips: list[Floats]) -> None:
        """Rows of one line strip each in local metres, east-north-up."""
        self._columns(
            entity, stamps(t, t_rx), rr.LineStrips3D.columns(strips=[strip.astype(np.float32) for strip in strips])
        )

    def geo_points(self, entity: str, t: Times, t_rx: Times, degrees: list[Floats]) -> None:
        """Rows of points, latitude and longitude in degrees."""
        columns = rr.GeoPoints.columns(positions=np.concatenate(degrees))
        self._columns(entity, stamps(t, t_rx), columns.partition([len(row) for row in degrees]))

    def geo_lines(self, entity: str, t: Times, t_rx: Times, degrees: list[Floats]) -> None:
        """Rows of one line each, latitude and longitude in degrees."""
        self._columns(entity, stamps(t, t_rx), rr.GeoLineStrings.columns(line_strings=degrees))

    def texts(self, entity: str, t: Times, t_rx: Times, texts: list[str], levels: list[str]) -> None:
        """Rows of the event log."""
        self._columns(entity, stamps(t, t_rx), rr.TextLog.columns(text=texts, level=levels))

    def once(self, entity: str, t: int, t_rx: int, *what: Any, window: int | None = None) -> None:
        """One row of anything, on every timeline it shall exist on."""
        self._stream.set_time("t_vehicle", timestamp=np.datetime64(t, "ns"))
        self._stream.set_time("t_rx", timestamp=np.datetime64(t_rx, "ns"))
        if window is not None:
            self._stream.set_time("window", sequence=window)
        self._stream.log(entity, *what)
        self._stream.reset_time()
        self.entities.add(entity)

    def state(self, entity: str, t: int, t_rx: int, state: str | None) -> None:
        """A lane changes its state; None leaves it unknown from here on (``StateChange(state=None)`` would be
        dropped).
        """
        change = rr.StateChange.from_fields(clear_unset=True) if state is None else rr.StateChange(state=state)
        self.once(entity, t, t_rx, change)

    def static(self, entity: str, what: Any) -> None:
        """Something that holds at all times, such as a style."""
        self._stream.log(entity, what, static=True)

    def property(self, name: str, **values: Any) -> None:
        """A static property of the whole recording."""
        self._stream.send_property(name, rr.AnyValues(**values))

    def started(self, t: int) -> None:
        """Say when the recording began, ns."""
        self._stream.send_recording_start_time_nanos(t)

    def layout(self, blueprint: Any) -> None:
        """Store a default layout; the last one counts."""
        self._stream.send_blueprint(blueprint, make_active=False, make_default=True)

    def flush(self, timeout: float = 10.0) -> bool:
        """Bring everything to the disk's queue; False when that fails, which the SDK tells nowhere else."""
        return self.sync(timeout)()

    def sync(self, timeout: float = 10.0) -> Callable[[], bool]:
        """The part of `flush` that takes time and may be done in another thread; gives back the rest of it."""
        try:
            self._stream.flush(timeout_sec=timeout)
        except Exception as error:  # the SDK raises a bare RuntimeError, and bindings may change it
            return partial(self._settle, str(error))
        return partial(self._settle, None)

    def _settle(self, trouble: str | None) -> bool:
        if trouble is not None:
            if not self.failing:
                self._on_alarm(
                    f"{self.path}: writing fails ({trouble}): free space on the disk; the raw log is not affected"
                )
            self.failing = True
            return False
        if self.failing:
            self._on_alarm(f"{self.path}: writing works again; what came in between may be missing")
        self.failing = False
        return True

    def close(self) -> bool:
        """Flush and finish the file."""
        done = self.flush()
        self._stream.disconnect()
        return done

    def abandon(self) -> None:
        """Let go of the file as it is."""
        self._stream.disconnect()

    def _stamps(self, t: Times, t_rx: Times, window: int | None) -> list[rr.TimeColumn]:
        """As `stamps`; the states of an estimate have the same times, so the columns are made once for all."""
        last = self._stamped
        if last is None or last[0] is not t or last[1] is not t_rx or last[2] != window:
            last = self._stamped = (t, t_rx, window, stamps(t, t_rx, window))
        return last[3]

    def _columns(self, entity: str, times: Iterable[rr.TimeColumn], columns: Any) -> None:
        self._stream.send_columns(entity, times, columns)
        self.entities.add(entity)


def degrees(points: Floats) -> NDArray[np.float64]:
    """Latitude and longitude in degrees of points in radians, shape (k, 2)."""
    return np.degrees(points[:, :2])
