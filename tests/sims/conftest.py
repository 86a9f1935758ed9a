"""One flight for all specs of the room."""

import pytest

import sims

UTC = 1_750_000_000_000_000_000


@pytest.fixture(scope="session")
def flight():
    return sims.fly("c172x", "demo", sensors="mems", seed=3, start_utc=UTC)


@pytest.fixture(scope="session")
def rough():
    """Half a minute of turning in turbulence, recorded four times as often."""
    return sims.fly("c172x", "turn", seed=5, duration=40, turbulence=3, record_rate=200, start_utc=UTC)


@pytest.fixture(scope="session")
def sent(flight):
    return list(sims.frames(flight))
