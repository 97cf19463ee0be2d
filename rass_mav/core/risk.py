"""Readings to risk: average first, clip last."""

from __future__ import annotations

import math

# Tuned: python -m tools.sensitivity risk
#: From this chance of loss in the next step on, data are in danger: saving airtime is no reason to wait.
DANGER = 0.05


class RiskEstimator:
    """Turns normalised readings into the local risk r of Eq. 3.

    Reading (unclipped; noise may make it negative) -> exponential moving average with `gain` -> clip to [0, 1].
    A reading that is missing, or older than `stale_s`, is unknown, and unknown counts as `worst`.
    """

    __slots__ = ("_at", "_mean", "_risk", "gain", "stale_s", "worst")

    def __init__(self, *, gain: float = 1.0, stale_s: float = 10.0, worst: float = 1.0) -> None:
        """`gain` in (0, 1], 1 = no averaging (the paper's policies); `stale_s` seconds; `worst` in [0, 1]."""
        if not 0.0 < gain <= 1.0 or not 0.0 <= worst <= 1.0 or stale_s <= 0.0:
            raise ValueError("gain must be in (0, 1], worst in [0, 1], stale_s > 0")
        self.gain = gain
        self.stale_s = stale_s
        self.worst = worst
        self._mean = self._risk = 0.0
        self._at: float | None = None

    def observe(self, reading: float, now: float) -> None:
        """Process a normalised reading (0 = `risk.low`, 1 = `risk.high`; not clipped) measured at `now`.

        A value that is not finite is not a reading: a sensor that sends nothing else grows stale.
        """
        if not math.isfinite(reading):
            return
        if self._at is None or now - self._at > self.stale_s:
            self._mean = reading
        else:
            # Not `mean += gain * (reading - mean)`: after one huge reading that rounds the small ones that follow to 0.
            self._mean = self.gain * reading + (1.0 - self.gain) * self._mean
        self._risk = min(max(self._mean, 0.0), 1.0)
        self._at = now

    def adopt(self, other: RiskEstimator, *, forget: bool) -> None:
        """Continue with the settings of another estimator. `forget`: without the average so far."""
        self.gain, self.stale_s, self.worst = other.gain, other.stale_s, other.worst
        if forget:
            self._at = None

    def known(self, now: float) -> bool:
        """Whether there is a recent enough reading."""
        return self._at is not None and now - self._at <= self.stale_s

    def risk(self, now: float) -> float:
        """The local risk in [0, 1]; `worst` when unknown."""
        if self._at is None or now - self._at > self.stale_s:
            return self.worst
        return self._risk

    def in_danger(self, now: float) -> bool:
        """Whether data here must not wait, nor be left alone."""
        return self.risk(now) >= DANGER
