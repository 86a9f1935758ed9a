"""Kernels compiled once for every model: model functions are called through pointers.

A kernel that is given numba's functions as they are is compiled anew for each of them, which takes seconds. Here it is
compiled for the type of such a function instead, and kept on disk: what is left to compile is the model itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import from_dtype, njit, typeof, types  # type: ignore[import-untyped, unused-ignore]
from numba.core.dispatcher import Dispatcher  # type: ignore[import-untyped, unused-ignore]
from numba.extending import register_jitable  # type: ignore[import-untyped, unused-ignore]

from estimator.ud import LEAN

P = ParamSpec("P")
T = TypeVar("T")


def woven(function: Callable[P, T]) -> Callable[P, T]:
    """A Python function that is written into compiled code where it is called, not compiled by itself.

    Every level of calls is compiled again with all that is below it: a stack of small functions takes minutes.
    """
    whole: Any = register_jitable(function)
    whole.targetoptions, whole.py_func = {"inline": "always"}, function  # what numba asks before it inlines a call
    return cast(Callable[P, T], whole)


class Kernel:
    """A kernel whose first ``functions`` arguments are model functions: run as Python, or compiled at its first use."""

    def __init__(self, kernel: Callable[..., Any], functions: int) -> None:
        self.kernel, self.functions = kernel, functions
        self.ready: dict[Any, Any] = {}
        self.special = njit(nogil=True)(kernel)

    def __call__(self, dtype: Any, driven: bool, *arguments: Any) -> Any:
        """Call the kernel; ``dtype`` is that of all arrays, ``driven`` says that the model takes inputs."""
        models = arguments[: self.functions]
        if not all(isinstance(model, Dispatcher) for model in models):
            return self.kernel(*arguments)
        vector = from_dtype(dtype)[::1]
        takes = (vector, vector) if driven else (vector,)
        if not all(_returns(model, takes) == vector for model in models):
            return self.special(*arguments)  # of another type than it is given: compiled for this model alone
        key = (dtype, driven)
        if key not in self.ready:
            dispatcher = njit(**LEAN)(self.kernel)
            rest = tuple(typeof(argument) for argument in arguments[self.functions :])  # type: ignore[no-untyped-call, unused-ignore]
            dispatcher.compile((types.FunctionType(vector(*takes)),) * self.functions + rest)
            dispatcher.disable_compile()
            self.ready[key] = dispatcher
        return self.ready[key](*arguments)


def _returns(model: Any, takes: tuple[Any, ...]) -> Any:
    """What it returns; None where it is compiled for other arguments only, or has more, which have defaults."""
    if takes not in model.overloads:
        try:
            model.compile(takes)
        except (RuntimeError, TypeError):
            return None
    return model.overloads[takes].signature.return_type
