"""When a window closes, and why.

Star coordinates x = phi_{j,0} x* are exact for ever in exact arithmetic; in float64 the covariance loses about
(1..30) eps kappa(phi_{j,0}) and the mean up to a hundred times that. So a window closes, and the next one is anchored
at the present epoch, before kappa grows past a limit or after a number of steps. Re-anchoring is exact
(``sweeps.anchor`` on the way forward, the hand-over in ``sweeps.backward`` on the way back): a chain of windows of any
lengths is one whole-interval smoothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.model import LinearModel
from estimator.ud import Array


@dataclass(frozen=True, slots=True, eq=False)
class Rule:
    """When a window closes: before its condition number passes ``kappa``, and at the latest after ``steps`` steps.

    Parameters
    ----------
    steps : int
        Longest window; 1 is the ordinary U-D information filter.
    kappa : float
        Largest infinity-norm condition number of S^{-1} phi_{j,0} S. It is estimated every 8 steps, and at every step
        for which the pivots at hand say that the limit is near. One step beyond the limit is a window of its own.
    scale : (n,) array or None
        Typical standard deviation of each state, the diagonal of S. None is S = I, which only closes too early.
    """

    steps: int = 100
    kappa: float = 1e4
    scale: Array | None = None

    @classmethod
    def of(cls, model: LinearModel, steps: int = 100) -> Rule:
        """The rule for a model: kappa is 1e4 in float64, and 1e2 in float32, which has half the digits to lose."""
        return cls(steps, 1e4 if model.dtype == np.float64 else 1e2)

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps is {self.steps}: a window has at least one step")
        if not self.kappa >= 1.0:
            raise ValueError(f"kappa is {self.kappa}: a condition number is at least 1")
        if self.scale is not None:
            scale = np.array(self.scale, dtype=np.float64)
            if scale.ndim != 1 or not (np.isfinite(scale).all() and (scale > 0.0).all()):
                raise ValueError("scale: one positive finite standard deviation per state is needed")
            object.__setattr__(self, "scale", scale)

    def scales(self, n: int) -> Array:
        """The diagonal of S, shape (n,)."""
        if self.scale is None:
            return np.ones(n)
        if self.scale.size != n:
            raise ValueError(f"scale has {self.scale.size} entries for {n} states")
        return self.scale
