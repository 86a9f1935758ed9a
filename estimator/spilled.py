"""Smoothing on disk: a record whose snapshots and results are files, in the memory of a few thousand steps.

The numbers are those of ``linear.smooth`` to the last bit; so is everything else but where the arrays lie.
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from estimator.information import Filtered, filter, start
from estimator.linear import Smoothed, believable, flags, from_epoch_0
from estimator.model import LinearModel
from estimator.smoother import Interval, stretches
from estimator.snapshots import SPILL, Store
from estimator.ud import Array
from estimator.window import Rule


class Results:
    """Arrays that are written part by part into .npy files of a folder, and read back mapped.

    Leaving the context with an exception deletes them: what is there is whole.

    Parameters
    ----------
    folder : path
    lengths : dict
        Rows of each array, by name.
    shapes : dict
        Shape of a row.
    dtype : numpy dtype

    Raises
    ------
    FileExistsError
        One of the files is there already.
    """

    def __init__(
        self, folder: Path, lengths: dict[str, int], shapes: dict[str, tuple[int, ...]], dtype: np.dtype[np.generic]
    ) -> None:
        self._paths = {name: folder / f"{name}.npy" for name in lengths}
        self._lengths, self._shapes, self._dtype = lengths, shapes, dtype
        self._files: dict[str, tuple[BinaryIO, int]] = {}
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Results:
        try:
            for name, path in self._paths.items():
                if path.exists():
                    raise FileExistsError(f"{path} is there already: choose a new or empty folder for spill")
                file = self._open.enter_context(path.open("xb"))
                shape = (self._lengths[name], *self._shapes[name])
                header = {"descr": self._dtype.str, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, header)
                self._files[name] = file, file.tell()
                file.truncate(file.tell() + int(np.prod(shape)) * self._dtype.itemsize)
        except BaseException:
            self._give_up()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._open.close()
        else:
            self._give_up()

    def _give_up(self) -> None:
        self._open.close()
        for name in self._files:
            self._paths[name].unlink(missing_ok=True)

    def write(self, name: str, row: int, part: Array) -> None:
        """Put ``part`` where row ``row`` is; nothing for an array without rows."""
        if self._lengths[name]:
            file, begin = self._files[name]
            file.seek(begin + row * self._dtype.itemsize * int(np.prod(self._shapes[name])))
            file.write(np.ascontiguousarray(part).tobytes())
            file.flush()

    def read(self, name: str) -> Array:
        """The whole array, mapped."""
        array: Array = np.load(self._paths[name], mmap_mode="r" if self._lengths[name] else None)
        return array


def smooth(
    model: LinearModel,
    z: ArrayLike,
    x0: ArrayLike | None,
    p0: ArrayLike | None,
    rule: Rule,
    wanted: frozenset[str],
    folder: Path,
) -> Smoothed:
    """As ``linear.smooth``; the snapshots are deleted afterwards, the results stay in ``folder``."""
    data = model.measurements(z)
    n, count, carry = model.n, data.shape[0], start(model.n, x0, p0, dtype=model.dtype)
    shapes = {"mean": (n,), "std": (n,), "covariance": (n, n), "cross": (n, n)}
    shapes |= {"filtered_mean": (n,), "filtered_std": (n,)}
    asked = wanted | {"mean"} | ({"filtered_mean", "filtered_std"} if "filtered" in wanted else set())
    lengths = {name: (count + (name != "cross")) * (name in asked) for name in shapes}

    def room(a: int, b: int) -> Interval:
        rows = {name: (b - a + (name != "cross")) * (lengths[name] > 0) for name in Interval._fields}
        mean = np.empty((rows["mean"], n, 1), model.dtype)
        return Interval(mean, *(np.empty((rows[name], *shapes[name]), model.dtype) for name in Interval._fields[1:]))

    folder.mkdir(parents=True, exist_ok=True)
    with Results(folder, lengths, shapes, model.dtype) as results, tempfile.TemporaryDirectory(dir=folder) as steps:
        store = Store(steps)
        none = Filtered(np.empty((0, n)), np.empty((0, n)), np.empty(0), np.empty(0, np.int64))
        before = from_epoch_0(model, x0, p0, none, wanted)
        results.write("filtered_mean", 0, before[0])
        results.write("filtered_std", 0, before[1])
        for a in range(0, count, SPILL):
            b = min(a + SPILL, count)
            carry, filtered = filter(
                model.cut(a, b), carry, data[a:b], rule=rule, store=store, estimates="filtered" in wanted, first=a
            )
            results.write("filtered_mean", a + 1, filtered.mean)
            results.write("filtered_std", a + 1, filtered.std)
        for a, stretch in stretches(store, carry, 0, room=room, **flags(wanted)):
            for name, array in zip(Interval._fields, stretch, strict=True):
                skip = 1 if a and name != "cross" else 0
                results.write(name, a + skip, array[skip:])
        std, filtered_std = results.read("std"), results.read("filtered_std")
        for a in range(0, count + 1, SPILL):
            believable(std[a : a + SPILL], filtered_std[a : a + SPILL], a)
        windows = [i for i in store.anchors if i < len(store)]
        return Smoothed(
            windows=windows, bytes_per_step=store.bytes_per_step, **{name: results.read(name) for name in shapes}
        )
