"""Bytes to time-stamped SI samples, on a bus; knows MAVLink, clocks, links and zenoh, and nothing of the project."""
