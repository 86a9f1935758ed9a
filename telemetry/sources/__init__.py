"""Where telemetry comes from: one file per kind of source.

Links and telemetry logs yield `telemetry.frames.Frames` in the order of arrival. On-board logs are no MAVLink: they
yield the messages of the vocabulary, as `telemetry.ingest.ingest` does.
"""
