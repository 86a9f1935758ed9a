"""A serial port: a telemetry radio, or an autopilot on a cable.

The device must be there at the start; one that is unplugged is opened again when it is back. Devices are numbered in
the order in which they are plugged in: a name under ``/dev/serial/by-id`` stays the device's own.
"""

from __future__ import annotations

import os
import termios
import time
from functools import partial
from selectors import BaseSelector
from typing import Any

import serial

from telemetry.sources.endpoint import Endpoint
from telemetry.sources.port import Journal
from telemetry.sources.stream import Retry, StreamChannel


def open_port(
    endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal, *, two_way: bool, ground: bool
) -> SerialPort:
    """Open ``serial`` (`telemetry.sources.port.open_port`)."""
    return SerialPort(endpoint, link, selector, journal)


class SerialPort:
    """A serial device, opened again whenever it vanishes."""

    def __init__(self, endpoint: Endpoint, link: int, selector: BaseSelector, journal: Journal) -> None:
        self.link = link
        self.kernel_drops = 0
        self._endpoint, self._selector, self._journal = endpoint, selector, journal
        self._name = f"link {link}: {endpoint}"
        self._retry = Retry()
        self._device: Any = None
        self._channel: StreamChannel | None = None
        self._closed = False
        self._open()

    def tick(self, now: float) -> None:
        """Open the device again when it is time."""
        if self._channel is None and not self._closed and self._retry.due(now):
            try:
                self._open()
            except OSError as error:
                self._journal.trouble(f"link {self.link}: {error.strerror}: trying again")
                self._retry.later(now)
            else:
                self._journal.tell("info", f"{self._name}: it is back", f"{self._name} back")

    def heard(self, origin: object) -> None:
        """There is only one who can be."""

    def send(self, unit: bytes, origin: object) -> None:
        """Write to the device."""
        if self._channel is None:
            self._journal.trouble(f"link {self.link}: not passed on to {self._endpoint}: it is not there")
        else:
            self._channel.send(unit)

    def close(self) -> None:
        """Close the device for good."""
        self._closed = True
        self._drop()

    def _open(self) -> None:
        device = self._endpoint.device
        try:
            self._device = serial.Serial(device, self._endpoint.baud, timeout=0, write_timeout=0, exclusive=True)
            number = self._device.fileno()
            settings = termios.tcgetattr(number)
            settings[6][termios.VMIN] = 1  # no bytes then means: it is gone; with 0 it also means: none for now
            termios.tcsetattr(number, termios.TCSANOW, settings)
        except (OSError, ValueError, termios.error) as error:  # ValueError: a speed that it does not know
            self._drop()
            code = error.errno if isinstance(error, OSError) else None
            why = os.strerror(code) if code else str(error)
            raise OSError(code, f"{self._endpoint}: {why}") from None
        self._channel = StreamChannel(
            self._endpoint,
            self.link,
            self._selector,
            self._journal,
            number,
            partial(os.read, number),
            partial(os.write, number),
            self._lost,
        )

    def _lost(self, channel: StreamChannel, why: str) -> None:
        self._journal.tell("warning", f"{self._name}: lost: {why}; trying again", f"{self._name} lost")
        if channel.received:
            self._retry.forget()
        self._drop()
        self._retry.later(time.monotonic())

    def _drop(self) -> None:
        if self._channel is not None:
            self._channel.close()
        if self._device is not None:
            self._device.close()
        self._device = self._channel = None
