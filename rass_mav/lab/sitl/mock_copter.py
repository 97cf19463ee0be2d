"""A mock of ArduCopter's SITL binary. It takes the same options, flies missions and forwards frames.

    python -m rass_mav.lab.sitl.mock_copter --model quad --home 45,-73,100,0 --defaults my.parm \
        --serial0 udpclient:127.0.0.1:5000 --serial1 udpclient:127.0.0.1:5001 --serial2 udpclient:127.0.0.1:5002

It behaves as measured on ArduCopter: before something is heard on a port, only its own messages go there. It forwards
frames unchanged, broadcasts to every other port, and others to the port where their target was heard. It has at most 20
routes and does not detect copies. Bit 10 of SERIALn_OPTIONS turns forwarding off for a port. Message rates are set with
SET_MESSAGE_INTERVAL, for each port separately. Missions: take-off, waypoints, speed, return.

As on ArduCopter, motors start only in a mode that allows it, and if the mode needs a position, only when one is known.
A mission needs a position, and takes off on MISSION_START. The defaults file also sets MAV_SYSID, INITIAL_MODE and
FLTMODE_CH. Unless FLTMODE_CH is 0, the mode switch of a simulated radio control is at STABILIZE, and INITIAL_MODE lasts
only until the switch is read.

It does not simulate PARAM messages, other modes, streams, wind, inertia or position errors. It flies in a straight line
at the configured speed, and knows its position.
"""

from __future__ import annotations

import argparse
import math
import selectors
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rass_mav.errors import ConfigError, MalformedError, RassError, os_errors_as
from rass_mav.lab.fleet.wires import whole_frames
from rass_mav.lab.swarm.autopilot import (
    METRES_PER_DEGREE,
    autopilot_heartbeat,
    global_position_int_payload,
    home_position,
    local_position_ned,
)
from rass_mav.link.address import parse_address
from rass_mav.link.sockets import MAX_DATAGRAM, MAX_PER_WAKE, udp_socket
from rass_mav.mavlink.component import ACCEPTED, CMD_SET_MESSAGE_INTERVAL, UNSUPPORTED, command_ack
from rass_mav.mavlink.dialect import MavlinkMessage, common, payload_of
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.identity import AUTOPILOT_COMPONENT, BROADCAST
from rass_mav.mavlink.messages import (
    COMMAND_ACK,
    COMMAND_LONG,
    GLOBAL_POSITION_INT,
    HEARTBEAT,
    HOME_POSITION,
    INFO,
    LOCAL_POSITION_NED,
    WARNING,
    parse,
    statustext,
)

from .mission import (
    CMD_ARM,
    CMD_RETURN,
    CMD_SET_MODE,
    CMD_SPEED,
    CMD_START,
    CMD_TAKEOFF,
    CMD_WAYPOINT,
    MISSION_COUNT,
    MISSION_CURRENT,
    MISSION_ITEM_INT,
    SIM_STATE,
    TEMPORARILY_REJECTED,
    MissionItem,
    mission_item,
    sim_state,
)

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


#: ArduPilot remembers that many senders.
MAX_ROUTES = 20
#: After the start it knows no position for so long, seconds.
FIX_S = 1.0
#: Most items of a mission.
MAX_ITEMS = 700
#: Bit of SERIALn_OPTIONS: nothing is passed on from or to the port.
NO_FORWARD = 1 << 10
#: What can be asked for.
STREAMS = (HEARTBEAT, SIM_STATE, GLOBAL_POSITION_INT, LOCAL_POSITION_NED, HOME_POSITION, MISSION_CURRENT)
_TICK_S = 0.05
_HEARTBEAT_S = 1.0
# MAV_SEVERITY.


class SerialPort:
    """One serial port, as a UDP client."""

    def __init__(self, number: int, address: tuple[str, int], system_id: int, forwards: bool) -> None:
        """`forwards`: whether it forwards frames in both directions."""
        self.number = number
        self.sock = udp_socket()
        self.sock.connect(address)
        self.forwards = forwards
        self.heard = False
        self.reader = FrameReader()
        self.streams: dict[int, list[float]] = {HEARTBEAT: [_HEARTBEAT_S, 0.0]}
        """Message id -> [interval, next time], seconds."""
        self._writer = FrameWriter(system_id, AUTOPILOT_COMPONENT)

    def say(self, message: MavlinkMessage) -> None:
        """Send one of our own messages."""
        self.put(self._writer.message(message))

    def say_packed(self, message_id: int, payload: bytes) -> None:
        """The same, packed already."""
        self.put(self._writer.frame(message_id, payload))

    def put(self, raw: bytes) -> None:
        """Send a frame. Like a serial port, it ignores a missing receiver or a full buffer."""
        try:
            self.sock.send(raw)
        except OSError:
            return


class MockCopter:
    """The vehicle. `hear` and `tick` do all the work; the caller provides the time (seconds since boot)."""

    def __init__(self, system_id: int, flight: MockFlight, ports: list[SerialPort]) -> None:
        self._id = system_id
        self.flight = flight
        self.ports = ports
        self._routes: dict[tuple[int, int], SerialPort] = {}
        self._upload: list[MissionItem | None] = []
        self._now = 0.0

    @property
    def _fix(self) -> bool:
        return self._now >= FIX_S

    def hear(self, port: SerialPort) -> None:
        """Handle what has arrived on a port."""
        for _ in range(MAX_PER_WAKE):
            try:
                data = port.sock.recv(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:
                continue  # there is no receiver yet
            for raw, frame in whole_frames(data, port.reader):
                self._frame(port, raw, frame)

    def tick(self, now: float) -> None:
        """Continue the flight, and send what is due."""
        for number in self.flight.fly(now - self._now):
            for port in self.ports:
                port.say(common.MAVLink_mission_item_reached_message(number))
        self._now = now
        for port in self.ports:
            for message_id, stream in port.streams.items():
                if now >= stream[1]:
                    stream[1] = max(stream[1] + stream[0], now)
                    payload = self._payload(message_id)
                    if payload is not None:
                        port.say_packed(message_id, payload)

    # -- what is heard -------------------------------------------------------------------------------------------------

    def _frame(self, port: SerialPort, raw: bytes, frame: Frame) -> None:
        sender = (frame.system_id, frame.component_id)
        if sender == (self._id, AUTOPILOT_COMPONENT):
            return  # our own frame came back
        port.heard = True
        if sender in self._routes or len(self._routes) < MAX_ROUTES:
            self._routes[sender] = port
        try:
            message = parse(frame)
        except MalformedError:
            return
        system = getattr(message, "target_system", BROADCAST)
        component = getattr(message, "target_component", BROADCAST)
        if system in (BROADCAST, self._id) and component in (BROADCAST, AUTOPILOT_COMPONENT):
            self._obey(port, frame, message)
        if (system, component) != (self._id, AUTOPILOT_COMPONENT):
            self._pass_on(port, raw, system, component)

    def _pass_on(self, port: SerialPort, raw: bytes, system: int, component: int) -> None:
        if not port.forwards:
            return
        to = {other for other in self.ports if other.heard}
        if system != BROADCAST:
            to &= {at for (s, c), at in self._routes.items() if s == system and component in (BROADCAST, c)}
        for other in to - {port}:
            if other.forwards:
                other.put(raw)

    def _obey(self, port: SerialPort, frame: Frame, message: MavlinkMessage) -> None:
        asker = frame.system_id, frame.component_id
        if frame.message_id == COMMAND_LONG and message.target_system == self._id:
            result = self._command(port, message)
            system, component = asker
            ack = command_ack(message.command, result, target_system=system, target_component=component)
            port.say_packed(COMMAND_ACK, ack)
        elif frame.message_id == MISSION_COUNT and message.mission_type == 0:
            self._upload = [None] * min(message.count, MAX_ITEMS)
            self._ask_on(port, asker)
        elif frame.message_id == MISSION_ITEM_INT and message.mission_type == 0:
            number, item = mission_item(frame)
            if number < len(self._upload):
                self._upload[number] = item
                self._ask_on(port, asker)

    def _ask_on(self, port: SerialPort, asker: tuple[int, int]) -> None:
        items = [item for item in self._upload if item is not None]
        if len(items) < len(self._upload):
            port.say(common.MAVLink_mission_request_int_message(*asker, self._upload.index(None)))
            return
        self.flight.load(items)
        self._upload = []
        port.say(common.MAVLink_mission_ack_message(*asker, common.MAV_MISSION_ACCEPTED))

    def _command(self, port: SerialPort, message: MavlinkMessage) -> int:
        if message.command == CMD_SET_MESSAGE_INTERVAL:
            message_id, interval_s = int(message.param1), message.param2 / 1e6
            if message_id not in STREAMS:
                return UNSUPPORTED
            if interval_s > 0:
                port.streams[message_id] = [interval_s, self._now]
            elif interval_s < 0:
                port.streams.pop(message_id, None)
            return ACCEPTED
        if message.command == CMD_ARM:
            if not message.param1:
                self.flight.disarm()
                return ACCEPTED
            if not self._fix and self.flight.mode != STABILIZE:
                return self._refuse("Arm: Need Position Estimate")
            if not self.flight.arm():
                return self._refuse("Arm: mode not armable")
            self._text(INFO, "Arming motors")
            return ACCEPTED
        if message.command == CMD_SET_MODE:
            mode = int(message.param2)
            if not self._fix and mode != STABILIZE:
                return self._refuse("Mode change failed: requires position")
            return ACCEPTED if self.flight.set_mode(mode) else TEMPORARILY_REJECTED
        if message.command == CMD_START:
            if not self._fix:
                return self._refuse("Mode change to AUTO failed: requires position")
            return ACCEPTED if self.flight.start() else TEMPORARILY_REJECTED
        return UNSUPPORTED

    def _refuse(self, why: str) -> int:
        self._text(WARNING, why)
        return TEMPORARILY_REJECTED

    # -- what is said --------------------------------------------------------------------------------------------------

    def _text(self, severity: int, text: str) -> None:
        for port in self.ports:
            for piece in statustext(severity, text):
                port.say(piece)

    def _payload(self, message_id: int) -> bytes | None:
        """The payload of a message that is due; None: there is none yet."""
        flight = self.flight
        boot_ms = int(self._now * 1000)
        if message_id == HEARTBEAT:
            return payload_of(autopilot_heartbeat(armed=flight.armed, custom_mode=flight.mode))
        if message_id == SIM_STATE:
            return payload_of(sim_state(*flight.place, flight.velocity))
        if message_id == MISSION_CURRENT:
            return payload_of(common.MAVLink_mission_current_message(flight.current, max(len(flight.items) - 1, 0)))
        if message_id == GLOBAL_POSITION_INT:
            if not self._fix:
                # Autopilots send this before they know their position.
                return global_position_int_payload(0.0, 0.0, 0.0, 0.0, boot_ms)
            return global_position_int_payload(*flight.place, flight.height, boot_ms, velocity=flight.velocity)
        if not self._fix:
            return None
        if message_id == HOME_POSITION:
            return payload_of(home_position(*flight.home))
        return payload_of(local_position_ned(flight.y, flight.x, -flight.height, boot_ms, velocity=flight.velocity))


def run(copter: MockCopter) -> None:
    """Run in real time. Never returns."""
    boot = time.monotonic()
    with selectors.DefaultSelector() as selector:
        for port in copter.ports:
            selector.register(port.sock, selectors.EVENT_READ, port)
        due = 0.0
        while True:
            now = time.monotonic() - boot
            if now >= due:
                copter.tick(now)
                due = now + _TICK_S
            for key, _ in selector.select(max(0.0, due - (time.monotonic() - boot))):
                copter.hear(key.data)


def read_defaults(path: str | None) -> dict[str, float]:
    """Parameters from a file with a NAME and a VALUE on each line; `#` starts a comment. Raises `ConfigError`."""
    if path is None:
        return {}
    values = {}
    with os_errors_as(ConfigError, path):
        text = Path(path).read_text(encoding="utf-8")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            try:
                name, value = words
                values[name] = float(value)
            except ValueError:
                raise ConfigError(f"{path}: line {number}: expected a name and a number, got {line!r}") from None
    return values


def mode_after_boot(values: dict[str, float]) -> int:
    """The flight mode after the radio control has been read, according to the parameters."""
    return int(values.get("INITIAL_MODE", STABILIZE)) if values.get("FLTMODE_CH") == 0 else STABILIZE


def main(arguments: Sequence[str]) -> int:
    """Run the program. It refuses ArduCopter's other options, and ports other than `udpclient:`."""
    parser = argparse.ArgumentParser(prog="mock_copter", allow_abbrev=False)
    parser.add_argument("--model", "-M", required=True)
    parser.add_argument("--home", "-O", required=True)
    parser.add_argument("--instance", "-I", type=int, default=0)
    parser.add_argument("--rc-in-port", type=int)
    parser.add_argument("--defaults")
    for number in range(3):
        parser.add_argument(f"--serial{number}", dest=f"serial{number}")
    options = parser.parse_args(arguments)
    try:
        values = read_defaults(options.defaults)
        system_id = int(values.get("MAV_SYSID", values.get("SYSID_THISMAV", 1)))
        latitude, longitude, altitude, _ = (float(part) for part in options.home.split(","))
        ports = []
        for number in range(3):
            device = getattr(options, f"serial{number}")
            if device is None:
                continue
            kind, _, address = device.partition(":")
            if kind != "udpclient":
                raise ConfigError(f"--serial{number}: the mock supports only udpclient:host:port, got {device}")
            forwards = not int(values.get(f"SERIAL{number}_OPTIONS", 0)) & NO_FORWARD
            ports.append(SerialPort(number, parse_address(address), system_id, forwards))
    except RassError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    flight = MockFlight((latitude, longitude, altitude), mode=mode_after_boot(values))
    run(MockCopter(system_id, flight, ports))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
