"""Parameters beside the states: Friedland's separated filter of the flight path, and its smoother, compiled.

Shi's eq. (17) [3]_ has biases and scale errors b as constants beside the states x, where ``extended`` has all of
them in one state vector. Linearised, a step and a measurement are::

    x_{j+1} = Phi_j x_j + B_j b + c_j + Gam_j w_j            z = H x + C b + v

Given b, the states are known from a filter that knows nothing of b, and they are linear in b: x = x~ + V b. Its
innovations nu say of b what is left to say: nu = S b + e, e ~ N(0, s), s = H P~ H^T + r, independent in time [1]_::

    state filter    x~, P~ with b = 0              x^ = x~ + V b^                     P = P~ + V M V^T
    sensitivity     U = Phi V + B,  S = H U + C,  V = U - K~ S
    bias filter     M^{-1} += S^T S / s,  M^{-1} b^ += S^T nu / s
    smoother        x_{j/N} = x~_{j/N} + V_{j/N} b^_N,  P_{j/N} = P~_{j/N} + V_{j/N} M_N V_{j/N}^T

Here the state filter is the information smoother of ``extended`` for the 12 states that move (mode G: kinematics,
turbulence, wind), with one column of data for x~ and one more for each parameter: V is what the same smoother makes of
the data -(H S + C), and no equation of its own is needed. Absorbing a row leaves its residuals and the weight 1/s; that
row is what the bias filter absorbs. Both factors together are the triangle of the augmented filter with the parameters
in front, L = U D U^T, U = [U_b, U_bx; 0, U_x]: Friedland's separation is how a factor of the information is read. In
exact arithmetic nothing is lost. Nor is much work saved: measured in one run (mode G, 100 Hz, 3 scalars per step), the
way forward costs 0.8 to 0.95 of that of ``extended``, and the way back 1.3 to 1.6 of it wherever standard deviations
are wanted, because V has to be smoothed beside a covariance of 12 states in place of one of 21.

Forms
-----
"corrected"
    Linearised at x^ = x~ + V b^ and b^: equal to ``extended``, because every linearisation is the same.
"free"
    Linearised at x~ and the start of b, as Friedland's filter is when it is extended without feedback: what it leaves
    out is of second order in b, and in what x~ is off for want of b.
"paper"
    Filtered as "corrected" and smoothed as the paper words it: eqs. (14), (15) with b = b^_k, the parameters as they
    were known at each epoch, taken for known. Gains and covariances are those of P~ alone: the cross terms V M V^T are
    left out, and what is learnt of b later does not reach the states before.

A light aircraft in turbulence, 105 s, five draws of the sensors: differences from the augmented smoother in its sigmas,
largest (root mean square over states and times in brackets: of u, v, w and the angles), and how often the error of
phi is below two of its own:

=================  ============================  ============================
form               flight-test sensors           small autopilot's sensors
=================  ============================  ============================
corrected          3e-10                         1e-10
free, states       0.7 (0.1 .. 0.3), .96         9 (1.6 .. 4), .61
free, biases       1.6                           69
paper, states      21 (1.0 .. 1.8), .93          57 (1.4 .. 12), .46
=================  ============================  ============================

Augmented and "corrected" have .97 and .96 there. The loss of "paper" is at the beginning, where b is not known yet; it
knows the parameters as well as the others do.

What no form here can have is a bias that walks [2]_: b is constant. Where the settings let biases walk, that noise is
left out, and ``Separated.constant`` says so. On ten minutes of a real flight with the default settings (0.006 m/s2 and
4e-4 rad/s per root second) that moved a bias by 2.6 and states by up to 43 of the sigmas that allow for the walk, and
made sigmas of states up to five times smaller.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Trans. Automatic Control 14 (1969) 359-367.
.. [2] M. B. Ignagni, "Separate-bias Kalman estimator with bias state noise", IEEE Trans. Automatic Control 35 (1990)
   338-341.
.. [3] Z. K. Shi, "A new algorithm of fixed-interval smoother and its application to flight test", Acta Automatica
   Sinica, 1991, eqs. (14)-(17). How b is estimated is in its reference [1], whose text was not at hand.
"""

from estimator.separated.blocks import absorb
from estimator.separated.smoother import Form, Separated, separated

__all__ = ["Form", "Separated", "absorb", "separated"]
