"""Meet in the middle: one long record smoothed by two threads.

Run backwards, a linear system is a linear system again, and nothing is known about it before its first measurement:

    x_j = phi_j^{-1} x_{j+1} - phi_j^{-1} gamma_j w_j           j = N-1 .. c

So the first half of the record is filtered forward to epoch c while the second half is filtered backward to it. Each
measurement belongs to one half: z_{c-1}, taken at epoch c, to the first; z_{N-1}, taken at epoch N, is what the second
begins with. In the middle the informations add up, and both halves are smoothed outward from the sum. In exact
arithmetic that is the smoothing of one thread.

What the second half knows of the middle, L = U diag(D) U^T and U^T x = eta, is n independent measurements: rows U^T,
values eta, variances 1/D. They are absorbed like any others; a zero pivot is a missing one.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from estimator import ud
from estimator.information import Carry, anchor, factors, filter, start
from estimator.linear import Smoothed, believable, flags, from_epoch_0, smooth
from estimator.model import LinearModel
from estimator.smoother import backward
from estimator.snapshots import Store
from estimator.sweeps import limits
from estimator.ud import Array, compiled, factor, solve
from estimator.window import Rule

ud.follow(__file__)

FIRST = 4  # steps until the first look at whether the second half knows every direction yet; then twice as many
GROWTH = 100.0  # of a direction unseen so far: what rounding has left in it then weighs GROWTH^2 times as much
STILL = Rule(steps=2**31, kappa=np.inf)  # for a step with phi = I, which needs no window of its own


def smooth_from_both_ends(
    model: LinearModel,
    z: ArrayLike,
    x0: ArrayLike | None,
    p0: ArrayLike | None,
    window: int | None,
    want: frozenset[str],
) -> Smoothed:
    """Smooth both halves of a record at the same time.

    Parameters
    ----------
    model, z, x0, p0, window
        As in ``estimator.smooth``.
    want : set of names among "mean", "std", "covariance", "cross", "filtered"
        The filter's estimates are known up to the middle, epoch (N + 1) // 2: later rows are NaN and infinity.

    Returns
    -------
    Smoothed, as from one thread up to rounding; windows of the second half are those closed on the way from its end.

    Raises
    ------
    ValueError
        As ``estimator.smooth``.

    Notes
    -----
    One thread has the last word. What cannot be done from both ends is left to ``estimator.smooth``, filter's estimates
    and all: data with an error in them, which is then the same error naming the same step, and second halves that leave
    a direction unknown but for rounding (an exact zero is no trouble), or known only after it has grown a hundredfold.
    """
    z = model.measurements(z)
    if z.shape[0] > 1:
        try:
            return _meet(model, z, x0, p0, Rule.of(model) if window is None else Rule.of(model, window), want)
        except ValueError:
            pass
    return smooth(model, z, x0=x0, p0=p0, window=window, want=want)


def _meet(
    model: LinearModel, z: Array, x0: ArrayLike | None, p0: ArrayLike | None, rule: Rule, want: frozenset[str]
) -> Smoothed:
    count, n = z.shape[0], model.n
    middle = (count + 1) // 2
    begin = start(n, x0, p0, dtype=model.dtype)
    ahead, behind = Store(), Store()
    mean = np.empty((count + 1, n), z.dtype)
    std = np.empty((count + 1 if "std" in want else 0, n), z.dtype)
    covariance = np.empty((count + 1 if "covariance" in want else 0, n, n), z.dtype)
    cross = np.empty((count if "cross" in want else 0, n, n), z.dtype)

    def outward(store: Store, carry: Carry, *, back: bool) -> None:
        """Smooth one half. The second lies in the store from epoch N down to the middle, which the first writes."""
        smoothed = backward(store, carry, **flags(want))
        epochs = slice(count, middle, -1) if back else slice(middle + 1)
        rows = count - middle if back else middle + 1
        for part, whole in ((smoothed.mean, mean), (smoothed.std, std), (smoothed.covariance, covariance)):
            if whole.size:
                whole[epochs] = part[:rows]
        if cross.size and back:
            cross[: middle - 1 : -1] = smoothed.cross.transpose(0, 2, 1)
        elif cross.size:
            cross[:middle] = smoothed.cross

    with ThreadPoolExecutor(1) as other:
        reverse = _backwards(model, middle, count, other)
        second = other.submit(_from_the_end, model, reverse, z, middle, rule, behind)
        estimates = "filtered" in want
        first, seen = filter(model.cut(0, middle), begin, z[:middle], rule=rule, store=ahead, estimates=estimates)
        met = combined(first, second.result(), model)
        rest = other.submit(outward, behind, met, back=True)
        outward(ahead, met, back=False)
        rest.result()
    filtered_mean = np.full((count + 1 if estimates else 0, n), np.nan, z.dtype)
    filtered_std = np.full_like(filtered_mean, np.inf)
    if estimates:
        filtered_mean[: middle + 1], filtered_std[: middle + 1] = from_epoch_0(model, x0, p0, seen, want)
    believable(std, filtered_std)
    windows = [i for i in ahead.anchors if i < middle]
    windows += [middle, *sorted(count - i for i in behind.anchors if 0 < i < count - middle)]
    return Smoothed(mean, covariance, std, filtered_mean, filtered_std, windows, ahead.bytes_per_step, cross)


def combined(first: Carry, second: Carry, model: LinearModel) -> Carry:
    """What two carries know of one epoch from different measurements, together, and anchored there.

    The second is not anchored first: that would leave rounding where its pivots are zero.
    """
    ut, d, phi = factors(second)
    u, eta = ut[:, 1:].T, ut[:, 0]
    told = d > 0.0
    faint = limits(d.dtype)[1]
    if (told & (d <= faint * faint * ((u * u) @ d))).any():
        raise ValueError("the second half alone does not tell some direction from rounding")
    rows = np.linalg.solve(phi.T, u).T  # of x, not of x* = phi^{-1} x
    variance: Array = 1.0 / np.where(told, d, 1.0)
    still = _still(model, rows, variance)
    carry, _ = filter(still, first, np.where(told, eta, np.nan)[None], rule=STILL, estimates=False)
    return anchor(carry)


def _still(model: LinearModel, h: ArrayLike, r: ArrayLike) -> LinearModel:
    """A step on which nothing moves: measurements of the present epoch alone."""
    n = model.n
    return LinearModel(np.eye(n), np.zeros((n, 1)), np.zeros(1), h, r, dtype=model.dtype)


def _from_the_end(model: LinearModel, back: LinearModel, z: Array, middle: int, rule: Rule, store: Store) -> Carry:
    """Filter from epoch N down to epoch ``middle``, whose own measurement is left to the first half."""
    count = z.shape[0]
    last = model.cut(count - 1, count)
    carry, _ = filter(
        _still(model, last.h[0], last.r if last.r.ndim == 3 else last.r[0]), start(model.n, dtype=model.dtype), z[-1:],
        rule=STILL, estimates=False,
    )  # fmt: skip
    carry = anchor(carry)
    rest = z[middle - 1 : -1][::-1].copy()
    rest[-1] = np.nan
    since, at = np.eye(model.n, dtype=z.dtype), 0
    while at < rest.shape[0]:
        stop = rest.shape[0] if carry.regular else min(at + max(at, FIRST), rest.shape[0])
        if not carry.regular and not _growth(model.phi, count - stop, count - at, since) < GROWTH:
            raise ValueError("a direction that the end of the record does not show is growing towards it")
        carry, _ = filter(back.cut(at, stop), carry, rest[at:stop], rule=rule, store=store, estimates=False)
        at = stop
    return carry


def _backwards(model: LinearModel, first: int, stop: int, other: ThreadPoolExecutor) -> LinearModel:
    """The system of steps stop-1 .. first in that order; h and r of a step are those of the epoch where it now ends."""
    part, seen = model.cut(first, stop), model.cut(first - 1, stop - 1)
    phi = np.empty_like(part.phi)
    gamma = np.empty((max(part.phi.shape[0], part.gamma.shape[0]), model.n, model.p), phi.dtype)
    half = gamma.shape[0] // 2
    rest = other.submit(_invert, part.phi, part.gamma, half, gamma.shape[0], model.eps, phi, gamma)
    if not _invert(part.phi, part.gamma, 0, half, model.eps, phi, gamma) or not rest.result():
        raise ValueError("phi is singular")
    q, r = _variances(part.q[::-1]), _variances(seen.r[::-1])
    return LinearModel(_matrix(phi), _matrix(gamma), q, _matrix(seen.h[::-1]), r, dtype=model.dtype)


def _matrix(array: Array) -> Array:
    """As ``LinearModel`` wants it: without a leading axis when it is the same at all steps."""
    return array[0] if array.shape[0] == 1 else array


def _variances(array: Array) -> Array:
    """The same for q and r; as many rows as columns would be read as one covariance."""
    if array.ndim == 3:
        return array
    count, size = array.shape
    return array[0] if count == 1 else array[:, :, None] * np.eye(size) if count == size else array


@compiled
def _invert(phi: Array, gamma: Array, first: int, stop: int, eps: float, out_phi: Array, out_gamma: Array) -> bool:
    """Fill rows first .. stop-1 of phi^{-1} and -phi^{-1} gamma, last step first; False: some phi is singular."""
    n, p = gamma.shape[1], gamma.shape[2]
    lu, order = np.empty((n, n), phi.dtype), np.empty(n, np.int64)
    b, x = np.zeros((n, n + p), phi.dtype), np.empty((n, n + p), phi.dtype)
    for i in range(n):
        b[i, i] = 1.0
    count = out_gamma.shape[0]
    for i in range(first, stop):
        j = count - 1 - i
        if factor(phi[min(j, phi.shape[0] - 1)], lu, order, eps):
            return False
        now = gamma[min(j, gamma.shape[0] - 1)]
        for row in range(n):
            for c in range(p):
                b[row, n + c] = -now[row, c]
        solve(lu, order, b, x)
        for row in range(n):
            if i < out_phi.shape[0]:
                for c in range(n):
                    out_phi[i, row, c] = x[row, c]
            for c in range(p):
                out_gamma[i, row, c] = x[row, n + c]
    return True


@compiled
def _growth(phi: Array, first: int, stop: int, since: Array) -> float:
    """Extend ``since`` (n, n), the transition from where the filter stands to epoch N, by the steps stop-1 .. first.

    Returns the largest entry of its diagonal on the way: that does not depend on units, and grows as its modes do.
    """
    n = since.shape[0]
    now = np.empty((n, n), phi.dtype)
    most = 0.0
    for j in range(stop - 1, first - 1, -1):
        step = phi[min(j, phi.shape[0] - 1)]
        for row in range(n):
            now[row, :] = 0.0
            for k in range(n):
                t = since[row, k]
                for c in range(n):
                    now[row, c] += t * step[k, c]
        since[:, :] = now
        for row in range(n):
            most = max(most, abs(now[row, row]))
    return most
