"""How long answers take, and so how long to wait for one (RFC 6298)."""

from __future__ import annotations

from collections.abc import Collection

#: How fast the mean and the deviation follow new samples.
_GAIN, _DEVIATION_GAIN = 1 / 8, 1 / 4
#: Deviations above the mean that are waited for.
_DEVIATIONS = 4.0


class RoundTrips:
    """The times between hand-overs and their answers, by neighbour."""

    __slots__ = ("_trips",)

    def __init__(self) -> None:
        self._trips: dict[int, tuple[float, float]] = {}

    def measure(self, neighbour: int, trip_s: float) -> None:
        """An answer came after this time. Only to what was sent once: else it may belong to either time (Karn)."""
        mean, deviation = self._trips.get(neighbour, (trip_s, trip_s / 2))
        deviation += _DEVIATION_GAIN * (abs(trip_s - mean) - deviation)
        self._trips[neighbour] = mean + _GAIN * (trip_s - mean), deviation

    def wait_s(self, neighbour: int) -> float:
        """How long to wait for an answer of this neighbour, seconds; 0: it is not known."""
        mean, deviation = self._trips.get(neighbour, (0.0, 0.0))
        return mean + _DEVIATIONS * deviation

    def keep(self, neighbours: Collection[int]) -> None:
        """Forget all others."""
        if len(self._trips) > 2 * len(neighbours):
            self._trips = {id: trip for id, trip in self._trips.items() if id in neighbours}
