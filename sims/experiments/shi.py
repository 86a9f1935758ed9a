"""Shi's paper of 1991 in its own figures: Tables 1 to 5, formulas evaluated exactly and numbers as printed.

The paper [1]_ compares its smoother (MS) with Bierman's (SS) and Watanabe's (FPS) by operations and storage per step:
Table 1 the filter of MS row by row, Table 2 the smoothers, Table 3 the filters, Table 4 both together at six sizes,
Table 5 the numbers stored. Its Table 4 is the sum of Tables 2 and 3, but for a few slips, which `slip` finds.

References
----------
.. [1] Z. K. Shi, "A new algorithm of fixed-interval smoother and its application to flight test", Acta Automatica
   Sinica, 1991.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import NamedTuple

from sims.experiments.counting import Operations


class Size(NamedTuple):
    """States, noise components and measurements per step."""

    n: int
    p: int
    m: int


SIZES = (Size(10, 2, 2), Size(10, 6, 6), Size(10, 10, 10), Size(30, 4, 4), Size(30, 15, 15), Size(30, 30, 30))
METHODS = ("MS", "FPS", "SS")  # in the order of the paper

Three = tuple[Fraction, Fraction, Fraction]
Formula = Callable[[Fraction, Fraction, Fraction], Three]  # (n, p, m) -> additions, multiplications, divisions

ZERO, HALF, H = Fraction(0), Fraction(1, 2), Fraction(3, 2)

TABLE_1: Mapping[str, Formula] = {  # the filter of MS, row by row
    "E_j": lambda n, p, m: (n * p * (n - 1), n**2 * p, ZERO),
    "M_j+1": lambda n, p, m: (n * m * (n - 1), n**2 * m, ZERO),
    "C_j": lambda n, p, m: (n * p * (p - 1) / 2, n * p * (p + 1) / 2, ZERO),
    "U_q, D_q": lambda n, p, m: (n * p * (p + 1) + H * p * (p - 1), n * p * (p + 1) + HALF * p * (p - 1), p),
    "S_j": lambda n, p, m: (n * p * (n - 1) / 2, n * p * (n + 1) / 2, ZERO),
    "B_j": lambda n, p, m: ((n * p * (n - 1) + n * p * (p - 1)) / 2, (n * p * (n - 1) + n * p * (p + 1)) / 2, ZERO),
    "U_j+1/j, D_j+1/j": lambda n, p, m: (n * p * (n - 1), n * p * (n + 1), 2 * n),
    "U_j+1, D_j+1": lambda n, p, m: (n**2 * m, n**2 * m + 2 * n * m - m, 2 * m * (n - 1)),
    "x*_j": lambda n, p, m: (n**2 + 2 * m * n - n, n**2 + 2 * n * m + m, ZERO),
    "phi_j+1,0": lambda n, p, m: (n**2 * (n - 1), n**3, ZERO),
    "phi_j+1,0^-1": lambda n, p, m: ((2 * n**3 - 3 * n**2 + n) / 6, (n**3 - n) / 3, n),
}
TABULATED = ("phi_j+1,0", "phi_j+1,0^-1")  # rows that fall away when phi_{j,0} is a closed formula of j

TABLE_2: Mapping[str, Formula] = {  # the smoother
    "MS": lambda n, p, m: (H * n**3 + n**2 * (p + 1) + n * (p + H), H * n**3 + n**2 * (p + 2) - HALF * n, n - 1),
    "FPS": lambda n, p, m: (
        H * n**3 - HALF * n + n**2 + (H * n**3 + HALF * n**2 + 4 * n) * p,
        H * n**3 + 3 * n**2 - H * n + (H * n**3 + 3 * n**2 + Fraction(7, 2) * n) * p,
        (n - 1) * (1 + 3 * p),
    ),
    "SS": lambda n, p, m: (
        H * n**3 - HALF * n + n**2 + (H * n**3 + HALF * n**2 + 5 * n) * p,
        H * n**3 + 3 * n**2 - H * n + (H * n**3 + 3 * n**2 + Fraction(9, 2) * n) * p,
        (n - 1) * (1 + 3 * p),
    ),
}

TABLE_3: Mapping[str, Formula] = {  # the filter
    "MS": lambda n, p, m: (
        Fraction(4, 3) * n**3 + n**2 * (3 * p + 2 * m - HALF) + H * p * (p - 1)
        + n * (2 * p**2 + m - 3 * p - Fraction(5, 6)),
        Fraction(4, 3) * n**3 + n**2 * (3 * p + 2 * m + 1) - n / 3 + n * (2 * p**2 + 3 * p + 4 * m)
        + HALF * p * (p - 1),
        3 * n + p + 2 * m * (n - 1),
    ),
    "FPS": lambda n, p, m: (
        H * n**3 + HALF * n**2 * (3 * p + 2 * m + 1) + n * (m + Fraction(5, 2) * p),
        H * n**3 + n**2 * (m + H * p + 2) + n * (2 * m + Fraction(13, 2) * p - HALF),
        n - 1 + (n + 1) * p,
    ),
    "SS": lambda n, p, m: (
        H * n**3 + HALF * n**2 * (4 * p + 3 * m + 1) + H * n * m,
        H * n**3 + n**2 * (2 * p + H * m + 2) + n * (2 * p + Fraction(11, 2) * m - HALF),
        n * (3 * p + 1) + n * m - (p + 1),
    ),
}  # fmt: skip

TABLE_4: Mapping[Size, Mapping[str, Operations]] = {  # filter and smoother together, as printed
    Size(10, 2, 2): {
        "MS": Operations(4153, 4546, 77), "FPS": Operations(6895, 8089, 94), "SS": Operations(7075, 8290, 150),
    },
    Size(10, 6, 6): {
        "MS": Operations(7195, 7880, 153), "FPS": Operations(14580, 16500, 246), "SS": Operations(14980, 17100, 414),
    },
    Size(10, 10, 10): {
        "MS": Operations(10925, 11870, 229), "FPS": Operations(21895, 25180, 398), "SS": Operations(22795, 26180, 678),
    },
    Size(30, 4, 4): {
        "MS": Operations(85928, 89093, 355), "FPS": Operations(256035, 268680, 530),
        "SS": Operations(259515, 272280, 882),
    },
    Size(30, 15, 15): {
        "MS": Operations(157835, 163640, 1004), "FPS": Operations(733710, 775515, 1828),
        "SS": Operations(746760, 786090, 3148),
    },
    Size(30, 30, 30): {
        "MS": Operations(279875, 289275, 1889), "FPS": Operations(1385085, 1459740, 3598),
        "SS": Operations(1411185, 1486740, 6238),
    },
}  # fmt: skip

TABLE_5: Mapping[str, Callable[[int, int, int], int]] = {  # numbers kept per step
    "MS": lambda n, p, m: n**2 + n * (2 * p + 1) + p,
    "FPS": lambda n, p, m: n**2 + p * (2 * n + 3),
    "SS": lambda n, p, m: n**2 + 2 * p * (n + 1) + n,
}


def evaluated(formula: Formula, size: Size) -> Operations:
    """Evaluate a formula of the paper, exactly.

    Raises
    ------
    ValueError
        It does not give whole numbers.
    """
    values = formula(*(Fraction(value) for value in size))
    if any(value.denominator != 1 for value in values):
        raise ValueError(f"a formula of the paper gives no whole number of operations at {tuple(size)}: {values}")
    return Operations(*(int(value) for value in values))


def formulas(method: str, size: Size) -> Operations:
    """Table 2 and Table 3 together: what Table 4 should say."""
    return evaluated(TABLE_2[method], size) + evaluated(TABLE_3[method], size)


def slip(method: str, size: Size) -> Operations:
    """What Table 4 prints in excess of that."""
    return TABLE_4[size][method] - formulas(method, size)
