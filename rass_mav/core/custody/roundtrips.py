"""How long answers take, and so how long to wait for one (RFC 6298)."""

from __future__ import annotations

from collections.abc import Set

#: How fast the mean and the deviation follow new samples.
_GAIN, _DEVIATION_GAIN = 1 / 8, 1 / 4
#: Deviations above the mean that are waited for.
_DEVIATIONS = 4.0


class RoundTrips:
    """The times between hand-overs and their answers, by neighbour."""

    __slots__ = ("_least", "_missed", "_trips")

    def __init__(self) -> None:
        self._trips: dict[int, tuple[float, float]] = {}
        self._least: dict[int, float] = {}
        """How long to wait at least for neighbours that did not answer in time."""
        self._missed: dict[int, float] = {}
        """When the first answer was missed since the last measurement, seconds."""

    def measure(self, neighbour: int, trip_s: float) -> None:
        """An answer came after this time. Only to what was sent once: else it may belong to either time (Karn)."""
        self._least.pop(neighbour, None)
        self._missed.pop(neighbour, None)
        if neighbour not in self._trips:
            self._trips[neighbour] = trip_s, trip_s / 2
            return
        mean, deviation = self._trips[neighbour]
        deviation += _DEVIATION_GAIN * (abs(trip_s - mean) - deviation)
        self._trips[neighbour] = mean + _GAIN * (trip_s - mean), deviation

    def missed(self, neighbour: int, now: float, waited_s: float, most_s: float) -> None:
        """No answer came in this time, so the same is sent again. Once it may be lost, where the time is known;
        otherwise it may be late. Then what is sent next waits twice as long, up to `most_s`, until a measurement shows
        how long answers take (Karn, too)."""
        if self._missed.setdefault(neighbour, now) < now or neighbour not in self._trips:
            self._least[neighbour] = max(self._least.get(neighbour, 0.0), min(2 * waited_s, most_s))

    def usual_s(self, neighbour: int) -> float:
        """Within what time this neighbour answers, seconds; 0: it is not known."""
        mean, deviation = self._trips.get(neighbour, (0.0, 0.0))
        return mean + _DEVIATIONS * deviation

    def wait_s(self, neighbour: int) -> float:
        """How long to wait for an answer to what is sent for the first time, seconds; 0: it is not known."""
        return max(self.usual_s(neighbour), self._least.get(neighbour, 0.0))

    def keep(self, neighbours: Set[int]) -> None:
        """Forget all others."""
        if len(self._trips) + len(self._missed) > 4 * len(neighbours):
            for known in (self._trips, self._least, self._missed):
                for id in known.keys() - neighbours:
                    del known[id]
