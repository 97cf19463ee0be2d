"""How the mock vehicle flies: straight lines at constant speed, from one mission item to the next."""

from __future__ import annotations

import math

from rass_mav.lab.swarm.autopilot import METRES_PER_DEGREE

from .mission import CMD_RETURN, CMD_SPEED, CMD_TAKEOFF, CMD_WAYPOINT, MissionItem

#: Flight modes as ArduCopter counts them.
STABILIZE, AUTO, GUIDED, LOITER = 0, 3, 4, 5
#: Until a mission says otherwise, metres per second; up and down likewise.
SPEED_M_S = 5.0
CLIMB_M_S = 2.5


class MockFlight:
    """A multicopter without inertia. `fly` moves it; nothing else takes time."""

    def __init__(self, home: tuple[float, float, float], *, mode: int = STABILIZE) -> None:
        """`home`: its position, in degrees, degrees, metres above sea level. `mode`: the mode after power-up."""
        self.home = home
        self._started = False
        self._metres_east = METRES_PER_DEGREE * math.cos(math.radians(home[0]))
        self.x = self.y = self.height = 0.0
        """Metres east and north of home, and above it."""
        self.velocity = (0.0, 0.0, 0.0)
        """Metres per second to north, east and down."""
        self.mode = mode
        self.armed = False
        self.items: list[MissionItem] = []
        """Item 0 is home and is not flown."""
        self.current = 0
        self._speed = SPEED_M_S
        self._stayed = 0.0

    @property
    def place(self) -> tuple[float, float, float]:
        """Degrees, degrees, metres above sea level."""
        latitude, longitude, altitude = self.home
        return latitude + self.y / METRES_PER_DEGREE, longitude + self.x / self._metres_east, altitude + self.height

    def load(self, items: list[MissionItem]) -> None:
        """Take a new mission."""
        self.items = items
        self.current = 0
        self._stayed = 0.0

    def arm(self) -> bool:
        """Start the motors. False: this mode does not allow it."""
        self.armed = self.armed or self.mode in (STABILIZE, GUIDED, LOITER)
        return self.armed

    def disarm(self) -> None:
        """Stop the motors, on the ground."""
        self.armed = self.armed and self.height > 0

    def set_mode(self, mode: int) -> bool:
        """False: there is no such mode, or no mission to be flown."""
        if mode not in (STABILIZE, AUTO, GUIDED, LOITER) or (mode == AUTO and len(self.items) < 2):
            return False
        if mode == AUTO and self.current == 0:
            self.current = 1
        self.mode = mode
        return True

    def start(self) -> bool:
        """Take off, if the mission starts with that. False: motors are off, or there is no mission."""
        self._started = self.armed and self.set_mode(AUTO)
        return self._started

    def fly(self, seconds: float) -> list[int]:
        """Fly for some seconds. Returns the numbers of the items that were reached."""
        before = self.x, self.y, self.height
        reached = []
        left = seconds
        # The remaining time of a turn belongs to the next item.
        while self.armed and self.mode == AUTO and left > 0 and self.current < len(self.items):
            left = self._fly_item(self.items[self.current], left)
            if left > 0:
                reached.append(self.current)
                self.current += 1
                self._stayed = 0.0
        if self.items and self.current == len(self.items):
            self.current -= 1
            self.mode = LOITER
        if seconds > 0:
            x, y, z = ((now - then) / seconds for now, then in zip((self.x, self.y, self.height), before, strict=True))
            self.velocity = (y, x, -z)
        return reached

    def _fly_item(self, item: MissionItem, seconds: float) -> float:
        """The remaining time when the item is complete; 0: it is not complete."""
        if item.command == CMD_TAKEOFF:
            if not self._started:
                return 0.0
            return self._go(self.x, self.y, item.altitude, seconds)
        if item.command == CMD_SPEED:
            self._speed = item.param2 if item.param2 > 0 else self._speed
            return seconds
        if item.command == CMD_WAYPOINT:
            x = (item.longitude - self.home[1]) * self._metres_east
            y = (item.latitude - self.home[0]) * METRES_PER_DEGREE
            seconds = self._go(x, y, item.altitude, seconds)
            stay = min(seconds, item.param1 - self._stayed)
            self._stayed += stay
            return seconds - stay
        if item.command == CMD_RETURN:
            seconds = self._go(0.0, 0.0, self.height, seconds)
            if seconds > 0:
                seconds = self._go(0.0, 0.0, 0.0, seconds)
            if seconds > 0:
                self.armed = False
            return seconds
        return seconds

    def _go(self, x: float, y: float, height: float, seconds: float) -> float:
        """Fly towards a place, at most for the given time. Returns the remaining time; 0: it is not there yet."""
        across = math.hypot(x - self.x, y - self.y)
        up = abs(height - self.height)
        needed = max(across / self._speed, up / CLIMB_M_S)
        if needed <= seconds:
            self.x, self.y, self.height = x, y, height
            return seconds - needed
        part = seconds / needed
        self.x += (x - self.x) * part
        self.y += (y - self.y) * part
        self.height += (height - self.height) * part
        return 0.0
