"""Where bytes come from: one file per kind of source, all yielding `telemetry.frames.Frames` in the order of
arrival.
"""
