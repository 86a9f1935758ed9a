"""The extended information smoother: MS-A about a reference, for the kinematics of a flight path, compiled.

A step linearised at the estimate is x_{j+1} = Phi_j x_j + c_j + Gam_j w_j. The affine part enters as an offset,
x_j = s_j + phi_{j,0} x*_j, and what is left is the linear smoother of ``sweeps``::

    s_{j+1} = F(x_{j/j}) + Phi_j (s_j - x_{j/j})           z~ = z - h(x_{j+1/j}) + H (x_{j+1/j} - s_{j+1})
    forward    E = phi_{j+1,0}^{-1} Gam_j;  downdate by [0; E_c], 1/q_c;  update by [z~_i, H_i phi_{j+1,0}], 1/r_i
    anchor     V = phi^{-T} U,  eta := 0,  s := x_{k/k},  phi := I
    backward   x* <- x* + E_c (g_c - b_c^T x*);  at an anchor x* := phi^{-1} (s_new + x* - s_old)

One number per state and step is kept beside the snapshots of the linear smoother, s_j, and the nominal attitude about
which it is. A pass about a given trajectory (``About``) is the Gauss-Newton step of the whole problem; turbulence and
wind are then taken from the present prediction, because latent gusts make the exact solution biased.

phi_{j,0} is blocks: kinematics (7), the biases that drive them (6), and a diagonal. States are ordered with the
kinematics last, so that the noise of the inertial sensors changes the last seven columns of U only::

    [tail | ba, bg | h, v, a]       tail: kV, b_alpha, b_beta (k_alpha, k_beta), W (mode G), T
"""

from pathlib import Path

from estimator import ud
from estimator.extended.backward import backward, finish
from estimator.extended.blocks import EPS, anchor, named, wrapped
from estimator.extended.forward import ROW, forward
from estimator.extended.structures import (
    ABSENT,
    REJECTED,
    USED,
    WALKS,
    WEAKENED,
    About,
    B,
    Carry,
    Drive,
    Flags,
    K,
    Model,
    Rows,
    Told,
)  # fmt: skip

ud.follow(__file__, *(str(Path(__file__).parent / f"{part}.py") for part in ("backward", "blocks", "forward")))

__all__ = [
    "ABSENT", "EPS", "REJECTED", "ROW", "USED", "WALKS", "WEAKENED", "About", "B", "Carry", "Drive", "Flags", "K",
    "Model", "Rows", "Told", "anchor", "backward", "finish", "forward", "named", "wrapped",
]  # fmt: skip
