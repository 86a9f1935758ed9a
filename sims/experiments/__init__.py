"""Experiments: what a paper printed, or what one method does better than another, found again by running the code."""
