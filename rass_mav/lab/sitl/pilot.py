"""The pilot of a flying swarm: one ground station (MAVSDK) that flies a mission with each vehicle.

It is a separate process, so that it can be ended at any moment. It is started with the name of a `PilotOrder` file
(JSON), reports in lines of JSON on stdout (`PilotReport`), and obeys one order on stdin: `start`. It ends when stdin
ends.

Before `start` it finds the vehicles, uploads the missions, waits until each knows its position, and arms. A vehicle
that does not trust its position yet refuses to arm, so the pilot asks repeatedly. After `start` it starts the missions
and reports their progress. It forwards the vehicles' texts.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import sys
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

from rass_mav.errors import ConfigError, SwarmError, installing
from rass_mav.lab.fleet.tether import watch

from .mission import MissionItem

#: How long a vehicle may take until it is heard, then until it is ready, and later until it flies, seconds. An
#: autopilot takes half a minute to trust a simulated GPS.
CONNECT_S = 60.0
OBEY_S = 120.0
_AGAIN_S = 1.0
# How many texts of a vehicle an error includes.
_LAST_WORDS = 3


class Flight(msgspec.Struct):
    """The flight of one vehicle."""

    node_id: int
    system_id: int
    port: int
    """Port of its ground station connection on 127.0.0.1."""
    items: list[MissionItem]


class PilotOrder(msgspec.Struct):
    """The order with which the pilot is started."""

    flights: list[Flight]


class PilotReport(msgspec.Struct):
    """A report of the pilot, as one line."""

    event: str
    """heard, uploaded, located, armed, ready (all of them), flying, item, text, failed"""
    node_id: int = -1
    item: int = 0
    """With item: the current one."""
    text: str = ""
    """With failed: the reason. With text: a text of the vehicle (STATUSTEXT)."""


def need_mavsdk() -> None:
    """Raise `ConfigError` if MAVSDK 4 is missing. Call it before anything is started."""
    try:
        there = importlib.util.find_spec("mavsdk.asyncio") is not None
    except ModuleNotFoundError:
        there = False
    if not there:
        raise ConfigError(
            f"sitl needs MAVSDK 4 to fly: {installing('sitl')} (packages exist only for 64-bit computers)"
        )


class Pilot:
    """Flies one vehicle."""

    def __init__(self, flight: Flight, system: Any, tell: Callable[[PilotReport], None]) -> None:
        """`system`: MAVSDK's."""
        from mavsdk.asyncio.plugins.action.action import ActionAsync
        from mavsdk.asyncio.plugins.mission_raw.mission_raw import MissionRawAsync
        from mavsdk.asyncio.plugins.telemetry.telemetry import TelemetryAsync

        self._flight = flight
        self._tell = tell
        self._action = ActionAsync(system)
        self._mission = MissionRawAsync(system)
        self._telemetry = TelemetryAsync(system)
        self._said: deque[str] = deque(maxlen=_LAST_WORDS)

    async def prepare(self) -> None:
        """Upload the mission, wait for a position, and arm. Raises `SwarmError`."""
        until = asyncio.get_running_loop().time() + OBEY_S
        items = [_raw(number, item) for number, item in enumerate(self._flight.items)]
        await self._until_done("upload the mission", lambda: self._mission.upload_mission(items), until)
        self._say("uploaded")
        await self._until_done("report its position", lambda: self._telemetry.set_rate_position(1.0), until)
        try:
            await asyncio.wait_for(self._locate(), until - asyncio.get_running_loop().time())
        except asyncio.TimeoutError:
            raise self._failed(f"no position within {OBEY_S:g} s") from None
        self._say("located")
        await self._until_done("arm", self._action.arm, until)
        self._say("armed")

    async def _locate(self) -> None:
        """Wait until it reports a position. Before it knows one, it reports 0 degrees north and east."""
        async with contextlib.aclosing(self._telemetry.subscribe_position()) as positions:
            async for position in positions:
                if position.latitude_deg or position.longitude_deg:
                    return

    async def listen(self) -> None:
        """Forward the vehicle's texts. Never returns."""
        async with contextlib.aclosing(self._telemetry.subscribe_status_text()) as texts:
            async for text in texts:
                if text.text not in self._said:
                    self._said.append(text.text)
                self._tell(PilotReport("text", self._flight.node_id, text=text.text))

    async def fly(self) -> None:
        """Start the mission and report its progress. Never returns. Raises `SwarmError`."""
        until = asyncio.get_running_loop().time() + OBEY_S
        await self._until_done("start the mission", self._mission.start_mission, until)
        self._say("flying")
        item = 0
        async with contextlib.aclosing(self._mission.subscribe_mission_progress()) as progress:
            async for now in progress:
                if now.current > item:
                    item = now.current
                    self._say("item", item=item)

    async def _until_done(self, what: str, call: Callable[[], Awaitable[object]], until: float) -> None:
        """Repeat a request until the vehicle is ready and accepts it, or until a time of the loop."""
        from mavsdk.exceptions import MavsdkError

        while True:
            try:
                await call()
                return
            except MavsdkError as error:
                if asyncio.get_running_loop().time() > until:
                    raise self._failed(f"does not {what}: {error}") from None
            await asyncio.sleep(_AGAIN_S)

    def _failed(self, how: str) -> SwarmError:
        said = f": {' | '.join(self._said)}" if self._said else ""
        return SwarmError(f"vehicle {self._flight.node_id}: {how}{said}")

    def _say(self, event: str, *, item: int = 0) -> None:
        self._tell(PilotReport(event, self._flight.node_id, item))


def _raw(number: int, item: MissionItem) -> Any:
    from mavsdk.plugins.mission_raw import MissionItem as RawItem

    return RawItem(
        seq=number, frame=item.frame, command=item.command, current=int(number == 0), autocontinue=1,
        param1=item.param1, param2=item.param2,
        x=round(item.latitude * 1e7), y=round(item.longitude * 1e7), z=item.altitude,
    )  # fmt: skip


async def connect(sdk: Any, flights: list[Flight], tell: Callable[[PilotReport], None]) -> list[Pilot]:
    """Connect to all vehicles, and wait until each has answered. Raises `SwarmError`."""
    for flight in flights:
        await sdk.add_any_connection(f"udpout://127.0.0.1:{flight.port}")
    pilots: dict[int, Pilot] = {}
    loop = asyncio.get_running_loop()
    until = loop.time() + CONNECT_S
    while True:
        heard = {await s.get_system_id(): s for s in await sdk.get_systems() if await s.has_autopilot()}
        for flight in flights:
            if flight.system_id in heard and flight.node_id not in pilots:
                pilots[flight.node_id] = Pilot(flight, heard[flight.system_id], tell)
                tell(PilotReport("heard", flight.node_id))
        if len(pilots) == len(flights):
            return [pilots[flight.node_id] for flight in flights]
        if loop.time() > until:
            silent = [f"{flight.node_id}" for flight in flights if flight.node_id not in pilots]
            raise SwarmError(f"vehicle {', '.join(silent)}: not heard within {CONNECT_S:g} s")
        await asyncio.sleep(0.2)


async def fly(order: PilotOrder, tell: Callable[[PilotReport], None], started: asyncio.Event) -> None:
    """Do everything. It ends only with a `SwarmError`."""
    from mavsdk.asyncio.mavsdk import Mavsdk
    from mavsdk.component_type import ComponentType
    from mavsdk.mavsdk import Configuration

    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as sdk:
        pilots = await connect(sdk, order.flights, tell)
        listening = [asyncio.create_task(pilot.listen()) for pilot in pilots]
        try:
            await asyncio.gather(*(pilot.prepare() for pilot in pilots))
            tell(PilotReport("ready"))
            await started.wait()
            await asyncio.gather(*(pilot.fly() for pilot in pilots))
        finally:
            # Unsubscribe while the connection still exists.
            for task in listening:
                task.cancel()
            await asyncio.wait(listening)


def main(arguments: Iterable[str]) -> int:
    """Run the process. It is ended from outside, or by a vehicle that does not obey (exit code 1)."""
    (path,) = arguments
    order = msgspec.json.decode(Path(path).read_bytes(), type=PilotOrder)

    def tell(report: PilotReport) -> None:
        sys.stdout.buffer.write(msgspec.json.encode(report) + b"\n")
        sys.stdout.buffer.flush()

    async def scenario() -> None:
        started = asyncio.Event()
        loop = asyncio.get_running_loop()
        threading.Thread(target=_listen, args=(loop, started), name="orders", daemon=True).start()
        await fly(order, tell, started)

    try:
        asyncio.run(scenario())
    except SwarmError as error:
        tell(PilotReport("failed", text=str(error)))
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def _listen(loop: asyncio.AbstractEventLoop, started: asyncio.Event) -> None:
    """Wait for the order, then for the end of stdin, and end at once."""
    if sys.stdin.readline().strip() == "start":
        loop.call_soon_threadsafe(started.set)
    watch(sys.stdin.fileno())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
