"""Other smoothers for the same linear systems. One file each, with ``smooth(model, z, x0, p0, window) -> Smoothed``."""

METHODS = {"rts": "estimator.rivals.rts"}
