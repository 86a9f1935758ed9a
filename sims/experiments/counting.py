"""Counting arithmetic: the same source, run with numbers that count what is done with them.

A `Counted` is a float and the tally it reports to. Arrays of them are numpy object arrays, and a second copy of the
package ``estimator`` (`Counting`), loaded beside the compiled one and not compiled, runs its kernels on them: the code
objects are the very ones that numba compiles, only the names ``numba`` and ``numpy`` mean something else in it.

What is counted
---------------
Additions (subtractions are additions), multiplications, divisions and square roots, by the path of kernels that they
were done in. A change of sign, a comparison, an absolute value and a copy cost nothing.

An operation that only exists because a matrix is stored with its zeros and ones, or because a sum starts from nothing,
is *structural* and counted apart: an addition of an exact zero, a multiplication by an exact zero or one, a division of
an exact zero or by an exact one. Operation counts on paper leave these out, so what is left, the *arithmetic*, is what
may be compared with them; both together are what was *executed*. In dense random data other zeros and ones arise only
where an argument is one by choice: the scales of the window rule are, unless somebody gives them.
"""

from __future__ import annotations

import builtins
import importlib
import importlib.util
import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

PACKAGE = "estimator"
ADD, MULTIPLY, DIVIDE, ROOT, STRUCTURAL = 0, 1, 2, 3, 4  # a structural operation of kind k is counted at STRUCTURAL + k

Path = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Operations:
    """Numbers of operations; they add up, and can be taken from one another."""

    additions: int = 0
    multiplications: int = 0
    divisions: int = 0
    roots: int = 0

    @property
    def total(self) -> int:
        """All together."""
        return self.additions + self.multiplications + self.divisions + self.roots

    def __add__(self, other: Operations) -> Operations:
        return Operations(
            self.additions + other.additions, self.multiplications + other.multiplications,
            self.divisions + other.divisions, self.roots + other.roots,
        )  # fmt: skip

    def __sub__(self, other: Operations) -> Operations:
        return Operations(
            self.additions - other.additions, self.multiplications - other.multiplications,
            self.divisions - other.divisions, self.roots - other.roots,
        )  # fmt: skip


class Tally:
    """What was counted, by the path of kernels from the outermost to the innermost one.

    Attributes
    ----------
    path : tuple of str
        Where the count is now; empty outside of every kernel.
    here : list of int
        The counts at ``path``.
    """

    def __init__(self) -> None:
        self.path: Path = ()
        self.here = [0] * (2 * STRUCTURAL)
        self._counts: dict[Path, list[int]] = {(): self.here}

    @contextmanager
    def inside(self, name: str) -> Iterator[None]:
        """Count under ``name`` within the present path."""
        outside, here = self.path, self.here
        self.path = (*outside, name)
        self.here = self._counts.setdefault(self.path, [0] * (2 * STRUCTURAL))
        try:
            yield
        finally:
            self.path, self.here = outside, here

    def arithmetic(self) -> dict[Path, Operations]:
        """Operations by path, without the structural ones."""
        return {path: Operations(*counts[:STRUCTURAL]) for path, counts in self._counts.items()}

    def structural(self) -> dict[Path, Operations]:
        """The structural operations by path."""
        return {path: Operations(*counts[STRUCTURAL:]) for path, counts in self._counts.items()}


class Counted:
    """A number that counts what is done with it. There is no way back to a float but ``value``: nothing leaks away."""

    __hash__ = None  # type: ignore[assignment]
    __slots__ = ("tally", "value")

    def __init__(self, value: float, tally: Tally) -> None:
        self.value = value
        self.tally = tally

    def __repr__(self) -> str:
        return f"Counted({self.value!r})"

    def __add__(self, other: Any) -> Any:
        b = other.value if other.__class__ is Counted else _number(other)
        if b is None:
            return NotImplemented
        a = self.value
        self.tally.here[STRUCTURAL + ADD if a == 0.0 or b == 0.0 else ADD] += 1
        return Counted(a + b, self.tally)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        b = other.value if other.__class__ is Counted else _number(other)
        if b is None:
            return NotImplemented
        a = self.value
        self.tally.here[STRUCTURAL + ADD if a == 0.0 or b == 0.0 else ADD] += 1
        return Counted(a - b, self.tally)

    def __rsub__(self, other: Any) -> Any:
        a = _number(other)
        return NotImplemented if a is None else Counted(a, self.tally) - self

    def __mul__(self, other: Any) -> Any:
        b = other.value if other.__class__ is Counted else _number(other)
        if b is None:
            return NotImplemented
        a = self.value
        plain = a != 0.0 and b != 0.0 and a != 1.0 and b != 1.0
        self.tally.here[MULTIPLY if plain else STRUCTURAL + MULTIPLY] += 1
        return Counted(a * b, self.tally)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        b = other.value if other.__class__ is Counted else _number(other)
        if b is None:
            return NotImplemented
        a = self.value
        self.tally.here[STRUCTURAL + DIVIDE if a == 0.0 or b == 1.0 else DIVIDE] += 1
        return Counted(a / b if b != 0.0 else math.copysign(math.inf, a) if a != 0.0 else math.nan, self.tally)

    def __rtruediv__(self, other: Any) -> Any:
        a = _number(other)
        return NotImplemented if a is None else Counted(a, self.tally) / self

    def __pow__(self, power: Any) -> Any:
        if power == 0.5:
            return self.sqrt()
        if power.__class__ is not int or power < 1:
            return NotImplemented
        result = self
        for _ in range(power - 1):
            result = result * self
        return result

    def sqrt(self) -> Counted:
        """The square root: what ``np.sqrt`` calls."""
        self.tally.here[ROOT] += 1
        return Counted(math.sqrt(self.value) if self.value >= 0.0 else math.nan, self.tally)

    def __neg__(self) -> Counted:
        return Counted(-self.value, self.tally)

    def __abs__(self) -> Counted:
        return Counted(abs(self.value), self.tally)

    def __bool__(self) -> bool:
        return self.value != 0.0

    def __eq__(self, other: object) -> bool:
        return bool(self.value == _plain(other))

    def __lt__(self, other: object) -> bool:
        return bool(self.value < _plain(other))

    def __le__(self, other: object) -> bool:
        return bool(self.value <= _plain(other))

    def __gt__(self, other: object) -> bool:
        return bool(self.value > _plain(other))

    def __ge__(self, other: object) -> bool:
        return bool(self.value >= _plain(other))


def _number(value: Any) -> float | None:
    """A plain number as a float; None for what numpy has to take apart."""
    return float(value) if isinstance(value, (float, int, np.floating, np.integer)) else None


def _plain(value: Any) -> Any:
    return value.value if value.__class__ is Counted else value


def counted(array: Any, tally: Tally) -> Any:
    """An object array of `Counted`, of the shape of ``array``."""
    out = np.empty(np.shape(array), object)
    flat = out.reshape(-1)
    for i, value in enumerate(np.asarray(array, np.float64).reshape(-1).tolist()):
        flat[i] = Counted(value, tally)
    return out


def plain(array: Any) -> Any:
    """The float64 array of the values of ``array``, which may hold `Counted`."""
    return np.array([_plain(value) for value in array.reshape(-1)], np.float64).reshape(array.shape)


class _Standing(ModuleType):
    """Stands for another module; some of its names mean something else."""

    def __init__(self, module: ModuleType, **others: Any) -> None:
        super().__init__(module.__name__)
        self.__dict__.update(others)
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class Counting:
    """A second copy of the package ``estimator`` whose kernels count.

    Its functions take and give ordinary floats. Where one of them calls a kernel (what numba would compile), the float
    arrays and floats among the arguments become `Counted` and every operation in it is counted, kernels that it calls
    included; afterwards the results are written back as floats. What a matrix product costs is found under ``dot``.

    Parameters
    ----------
    **settings
        Values for arguments of kernels, by name, whatever their caller gives: ``per_component_mwgs=True``.

    Attributes
    ----------
    tally : Tally
    unheard : set of str
        Settings that no kernel has asked for so far.
    """

    def __init__(self, **settings: Any) -> None:
        self.tally = Tally()
        self.unheard = set(settings)
        self._settings = settings
        self._modules: dict[str, ModuleType] = {}
        self._numpy = _Standing(
            np, empty=self._maker(np.empty, None), zeros=self._maker(np.zeros, 0.0), ones=self._maker(np.ones, 1.0),
            eye=self._eye, isnan=self._test(math.isnan), isinf=self._test(math.isinf),
            isfinite=self._test(math.isfinite), dot=self._dot, finfo=self._finfo,
        )  # fmt: skip
        self._builtins = {**vars(builtins), "__import__": self._import}

    def module(self, name: str) -> ModuleType:
        """The copy of module ``name``, loaded when it is first asked for."""
        if name not in self._modules:
            # The one that is compiled comes first: the copy runs under its name, and dataclasses look that up.
            spec = importlib.import_module(name).__spec__
            assert spec is not None and spec.loader is not None
            copy = ModuleType(name)
            copy.__dict__.update(
                __builtins__=self._builtins, __file__=spec.origin, __package__=spec.parent, __spec__=spec
            )
            if spec.submodule_search_locations is not None:
                copy.__path__ = list(spec.submodule_search_locations)
            self._modules[name] = copy
            exec(spec.loader.get_code(name), copy.__dict__)  # type: ignore[attr-defined]
        return self._modules[name]

    def _import(self, name: str, space: Any = None, local: Any = None, wanted: Any = (), level: int = 0) -> Any:
        """What ``import`` does in the copy."""
        if level:
            name = importlib.util.resolve_name("." * level + name, space["__package__"])
        if name == "numba":
            return _Standing(importlib.import_module(name), njit=self._njit, jit=self._njit, prange=range)
        if name == "numpy":
            return self._numpy
        if name == "importlib":
            return _Standing(importlib, import_module=lambda name: self._import(name, wanted=("*",)))
        if name.partition(".")[0] != PACKAGE:
            return builtins.__import__(name, space, local, wanted, level=0)
        found = self.module(name)
        for item in wanted or ():
            if item != "*" and item not in vars(found) and importlib.util.find_spec(f"{name}.{item}") is not None:
                setattr(found, item, self.module(f"{name}.{item}"))
        return found if wanted else self.module(PACKAGE)

    def _njit(self, *arguments: Any, **_: Any) -> Any:
        """Stand for numba's decorator, with options or without."""
        return self._kernel(arguments[0]) if arguments and callable(arguments[0]) else self._kernel

    def _kernel(self, function: Callable[..., Any]) -> Callable[..., Any]:
        name = f"{function.__module__.removeprefix(PACKAGE + '.')}.{function.__qualname__}"
        signature = inspect.signature(function)

        def kernel(*arguments: Any, **named: Any) -> Any:
            if self.tally.path:
                with self.tally.inside(name):
                    return function(*arguments, **named)
            bound = signature.bind(*arguments, **named)
            bound.apply_defaults()
            given = {key: self._settings.get(key, value) for key, value in bound.arguments.items()}
            self.unheard -= given.keys()
            arrays: list[tuple[Any, Any]] = []
            bound.arguments.update({key: self._enter(value, arrays) for key, value in given.items()})
            with self.tally.inside(name):
                result = function(*bound.args, **bound.kwargs)
            for array, inside in arrays:
                if array.flags.writeable:
                    array[...] = plain(inside)
            return self._leave(result)

        return kernel

    def _enter(self, value: Any, arrays: list[tuple[Any, Any]]) -> Any:
        """What a kernel gets for an argument; float arrays are noted in ``arrays`` beside what stands for them."""
        if isinstance(value, tuple):
            items = [self._enter(item, arrays) for item in value]
            return type(value)._make(items) if hasattr(value, "_make") else tuple(items)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            for array, inside in arrays:
                if array is value:
                    return inside
                if (array.flags.writeable or value.flags.writeable) and np.shares_memory(array, value):
                    raise TypeError("two arguments of a kernel share memory: their copies would not")
            arrays.append((value, counted(value, self.tally)))
            return arrays[-1][1]
        return Counted(float(value), self.tally) if isinstance(value, (float, np.floating)) else value

    def _leave(self, value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(self._leave(item) for item in value)
        if isinstance(value, np.ndarray) and value.dtype == object:
            return plain(value)
        return _plain(value)

    def _maker(self, make: Callable[..., Any], value: float | None) -> Callable[..., Any]:
        """``np.empty`` and the like: inside a kernel an array of floats is one of objects."""

        def made(shape: Any, dtype: Any = np.float64, **options: Any) -> Any:
            if not self.tally.path or np.dtype(dtype).kind not in "fO":
                return make(shape, dtype, **options)
            return np.full(shape, value, object)

        return made

    def _eye(self, n: int, *more: Any, **options: Any) -> Any:
        return np.eye(n, *more, **options).astype(object) if self.tally.path else np.eye(n, *more, **options)

    def _test(self, of_float: Callable[[float], bool]) -> Callable[[Any], Any]:
        def test(value: Any) -> Any:
            return of_float(_plain(value)) if self.tally.path else getattr(np, of_float.__name__)(value)

        return test

    def _finfo(self, dtype: Any) -> Any:
        return np.finfo(np.float64 if np.dtype(dtype) == object else dtype)

    def _dot(self, a: Any, b: Any, out: Any = None) -> Any:
        if not self.tally.path:
            return np.dot(a, b, out)
        with self.tally.inside("dot"):
            return np.dot(a, b, out)
