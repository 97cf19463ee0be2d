"""How many data arrived when, and how long they were on their way."""

from __future__ import annotations

from collections import Counter
from math import log2
from typing import Any

#: Spans of time that are kept, and their length at first, seconds. Where there are more, spans become twice as long.
MOST_SPANS = 300
SPAN_S = 30.0
# Steps of delays for each doubling, and the shortest delay that is told from 0, seconds.
_STEPS = 8
_LEAST_S = 0.01


class Arrivals:
    """Counts by the time of arrival. Delays are known to 5 %."""

    def __init__(self) -> None:
        self.span_s = SPAN_S
        self._counts: Counter[int] = Counter()
        self._delays: dict[int, Counter[int]] = {}

    def take(self, arrived: float, delay_s: float | None) -> None:
        """A datum arrived, seconds since 1970. `delay_s`: its age then; None: unknown."""
        span = int(arrived // self.span_s)
        self._counts[span] += 1
        if delay_s is not None:
            self._delays.setdefault(span, Counter())[_step(delay_s)] += 1
        while len(self._counts) > MOST_SPANS:
            self._widen()

    def _widen(self) -> None:
        self.span_s *= 2
        counts, self._counts = self._counts, Counter()
        for span, count in counts.items():
            self._counts[span >> 1] += count
        delays, self._delays = self._delays, {}
        for span, steps in delays.items():
            self._delays.setdefault(span >> 1, Counter()).update(steps)

    def plain(self) -> dict[str, Any]:
        """For JSON: for each span with arrivals its start, their number, and the delays of half and of 95 % of them."""
        spans = sorted(self._counts)
        return {
            "span_s": self.span_s,
            "start": [span * self.span_s for span in spans],
            "count": [self._counts[span] for span in spans],
            "p50": [self._delay(span, 0.5) for span in spans],
            "p95": [self._delay(span, 0.95) for span in spans],
        }

    def _delay(self, span: int, part: float) -> float | None:
        """So large a part of the span's data had at most this delay, seconds; None: no delay is known."""
        steps = self._delays.get(span)
        if not steps:
            return None
        wanted = part * steps.total()
        for step in sorted(steps):
            wanted -= steps[step]
            if wanted <= 0:
                break
        return round(_LEAST_S * 2 ** (step / _STEPS), 3)


def _step(delay_s: float) -> int:
    return round(_STEPS * log2(max(delay_s, _LEAST_S) / _LEAST_S))
