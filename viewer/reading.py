"""Reading: a recording opened for reading, whatever state it was left in."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from telemetry.messages import Times


class Reading:
    """Everything in a recording, by entity.

    A file without index (its writer was killed) is read as it is. A file that ends inside a message is repaired into a
    temporary copy, which recovers all whole chunks; the original is never touched.

    Parameters
    ----------
    path : path
        An .rrd file, or a sortie folder with ``live.rrd`` and, as a layer, ``windows.rrd``.

    Attributes
    ----------
    files : list of Path
        What was read.
    remarks : list of str
        What was found wrong with the files, and what was done about it.

    Raises
    ------
    FileNotFoundError
        If there is no recording at the path.
    ValueError
        If a file is no recording.
    """

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        self.files = _files(path)
        self.remarks: list[str] = []
        self.truncated = False
        self.chunks: dict[str, list[Any]] = {}
        for file in self.files:
            self._read(file)

    def __enter__(self) -> Reading:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.chunks.clear()

    def _read(self, file: Path) -> None:
        try:
            chunks, footer = _chunks(file)
        except RuntimeError as error:
            chunks, footer = self._repaired(file, error), False
            self.truncated = True
        if not chunks:
            self.remarks.append(f"{file.name} holds nothing")
        elif not footer and not self.truncated:
            self.remarks.append(f"{file.name} has no index: its writer was stopped, or gave it up")
        for chunk in chunks:
            self.chunks.setdefault(chunk.entity_path, []).append(chunk)

    def _repaired(self, file: Path, error: RuntimeError) -> list[Any]:
        with tempfile.TemporaryDirectory(prefix="sortie-") as folder:
            copy = Path(folder) / file.name
            done = subprocess.run(
                [sys.executable, "-m", "rerun", "rrd", "optimize", str(file), "-o", str(copy)],
                capture_output=True,
                text=True,
            )
            if done.returncode or not copy.exists():
                raise ValueError(f"{file} is not a recording that can be read: {error}") from None
            chunks, _ = _chunks(copy)
            self.remarks.append(
                f"{file.name} ends in the middle of a message: all whole chunks were recovered into a temporary copy; "
                f"the viewer refuses the file itself: rerun rrd optimize {file} -o FILE writes one that it opens"
            )
            return chunks

    def batches(self, entity: str, component: str) -> list[pa.RecordBatch]:
        """Record batches of an entity that hold a component."""
        found = [chunk.to_record_batch() for chunk in self.chunks.get(entity, [])]
        return [batch for batch in found if component in batch.schema.names]

    def column(self, entity: str, component: str, timeline: str = "t_vehicle") -> tuple[Times, NDArray[Any]]:
        """Times and rows of one component, sorted by time; empty when there is none.

        Parameters
        ----------
        entity : str
            E.g. ``/v1/est/live/altitude``.
        component : str
            E.g. ``Measurements:values``.
        timeline : str
            ``t_vehicle``, ``t_rx`` or ``window``.

        Returns
        -------
        t : int64 array, shape (k,)
        rows : array, shape (k,) or (k, m)
            Numbers, or the texts as objects.
        """
        t, (rows,) = self.columns(entity, (component,), (timeline,))
        return t[0], rows

    def columns(
        self, entity: str, components: tuple[str, ...], timelines: tuple[str, ...]
    ) -> tuple[list[Times], list[NDArray[Any]]]:
        """Several components on several timelines, row by row, sorted by the first timeline."""
        parts = [
            batch
            for batch in self.batches(entity, components[0])
            if all(name in batch.schema.names for name in (*components, *timelines))
        ]
        if not parts:
            return [np.empty(0, np.int64) for _ in timelines], [np.empty(0) for _ in components]
        t = [np.concatenate([_flat(part.column(name)).view(np.int64) for part in parts]) for name in timelines]
        rows = [_stack([_rows(part.column(name)) for part in parts]) for name in components]
        order = np.argsort(t[0], kind="stable")
        return [column[order] for column in t], [row[order] for row in rows]

    def constant(self, entity: str, component: str) -> Any:
        """Static value of a component, the last one written; None when there is none."""
        values = [
            value for batch in self.batches(entity, component) for value in batch.column(component).to_pylist() if value
        ]
        return values[-1][0] if values else None


def column(path: str | Path, entity: str, component: str, timeline: str = "t_vehicle") -> tuple[Times, NDArray[Any]]:
    """One column of a recording; see `Reading.column`. For several, open a `Reading` once."""
    with Reading(path) as reading:
        return reading.column(entity, component, timeline)


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        if not (path / "live.rrd").exists():
            raise FileNotFoundError(f"{path} holds no live.rrd: name a sortie folder or an .rrd file")
        return [file for file in (path / "live.rrd", path / "windows.rrd") if file.exists()]
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such recording")
    return [path]


def _chunks(file: Path) -> tuple[list[Any], bool]:
    if file.stat().st_size == 0:
        return [], False
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            chunks = list(rr.chunk.RrdReader(file).stream())
        except ValueError as error:
            raise RuntimeError(str(error)) from None
    return chunks, not any("footer" in str(warning.message) for warning in caught)


def _flat(column: pa.Array) -> NDArray[np.int64]:
    if pa.types.is_integer(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False), np.int64)
    return np.asarray(column.cast(pa.int64()).to_numpy(zero_copy_only=False), np.int64)


def _rows(column: pa.ListArray) -> NDArray[Any]:
    """Rows of a component: numbers as an array of two dimensions, anything else as objects."""
    inner = column.type.value_type
    if pa.types.is_floating(inner) and not column.null_count:
        values, offsets = column.flatten().to_numpy(zero_copy_only=False), column.offsets.to_numpy()
        widths = np.diff(offsets)
        if len(widths) and (widths == widths[0]).all():
            return np.asarray(values).reshape(len(widths), int(widths[0]))
    rows = np.empty(len(column), object)
    rows[:] = [value[0] if value and len(value) == 1 else value for value in column.to_pylist()]
    return rows


def _stack(parts: list[NDArray[Any]]) -> NDArray[Any]:
    if all(part.ndim == 2 and part.shape[1] == parts[0].shape[1] for part in parts):
        rows = np.concatenate(parts)
        return rows[:, 0] if rows.shape[1] == 1 else rows
    return np.concatenate(
        [part if part.ndim == 1 else np.array([*map(list, part), None], object)[:-1] for part in parts]
    )
