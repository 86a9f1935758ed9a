"""Other smoothers for the same linear systems.

One file each, with ``smooth(model, z, x0, p0, window, want) -> Smoothed``, and one line here.
"""

METHODS = {
    "rts": "estimator.rivals.rts",
    "joseph": "estimator.rivals.joseph",
    "bierman": "estimator.rivals.bierman",
    "watanabe": "estimator.rivals.watanabe",
}
