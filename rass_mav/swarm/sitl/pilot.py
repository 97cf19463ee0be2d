"""The pilot of a flown swarm: one ground station (MAVSDK) that flies a mission with each vehicle.

A process of its own, so that it can be ended at any moment. Started with the name of a `PilotOrder` file (JSON). Says
what it has done in lines of JSON on stdout (`PilotReport`), and obeys one order on stdin: `start`. It ends when stdin
does.

Before `start` it finds the vehicles, uploads the missions, waits until each knows its position, and arms; a vehicle
that does not trust its position yet refuses that, so it asks again and again. Then it starts them, and reports how far
they are. It passes on what they say to people.
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
from rass_mav.mavlink.mission import MissionItem
from rass_mav.swarm.tether import watch

#: How long a vehicle may take until it is heard, then until it is ready, and later until it flies, seconds. A simulated
#: GPS takes half a minute to be believed.
CONNECT_S = 60.0
OBEY_S = 120.0
_AGAIN_S = 1.0
# How many texts of a vehicle an error repeats.
_LAST_WORDS = 3


class Flight(msgspec.Struct):
    """One vehicle's."""

    node_id: int
    system_id: int
    port: int
    """Of its station on 127.0.0.1."""
    items: list[MissionItem]


class PilotOrder(msgspec.Struct):
    """What the pilot is started with."""

    flights: list[Flight]


class PilotReport(msgspec.Struct):
    """A line of the pilot."""

    event: str
    """heard, uploaded, located, armed, ready (all of them), flying, item, text, failed"""
    node_id: int = -1
    item: int = 0
    """item: the one being flown."""
    text: str = ""
    """failed: why; text: what the vehicle says to people (STATUSTEXT)."""


def need_mavsdk() -> None:
    """Raise `ConfigError` if MAVSDK 4 is not there; before anything is started."""
    try:
        there = importlib.util.find_spec("mavsdk.asyncio") is not None
    except ModuleNotFoundError:
        there = False
    if not there:
        raise ConfigError(
            f"sitl needs MAVSDK 4 to fly: {installing('sitl')} (there are packages for 64-bit computers only)"
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
        await self._until_done("say its position", lambda: self._telemetry.set_rate_position(1.0), until)
        try:
            await asyncio.wait_for(self._locate(), until - asyncio.get_running_loop().time())
        except asyncio.TimeoutError:
            raise self._failed(f"no position within {OBEY_S:g} s") from None
        self._say("located")
        await self._until_done("arm", self._action.arm, until)
        self._say("armed")

    async def _locate(self) -> None:
        """Wait until it says a position: before it knows one, it says 0 degrees north and east."""
        async with contextlib.aclosing(self._telemetry.subscribe_position()) as positions:
            async for position in positions:
                if position.latitude_deg or position.longitude_deg:
                    return

    async def listen(self) -> None:
        """Pass on for ever what it says to people."""
        async with contextlib.aclosing(self._telemetry.subscribe_status_text()) as texts:
            async for text in texts:
                if text.text not in self._said:
                    self._said.append(text.text)
                self._tell(PilotReport("text", self._flight.node_id, text=text.text))

    async def fly(self) -> None:
        """Start, and report for ever. Raises `SwarmError`."""
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
        """A vehicle refuses what it is not ready for yet: ask again, until a time of the loop."""
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
    """Call all vehicles, and wait until each has answered. Raises `SwarmError`."""
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
    """All of it; ends only with a `SwarmError`."""
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
            # They hang up while there is still somebody to hang up on.
            for task in listening:
                task.cancel()
            await asyncio.wait(listening)


def main(arguments: Iterable[str]) -> int:
    """The process. It is ended from outside, or by a vehicle that does not obey (exit code 1)."""
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
    """The one order; then wait for the end of stdin, and end at once."""
    if sys.stdin.readline().strip() == "start":
        loop.call_soon_threadsafe(started.set)
    watch(sys.stdin.fileno())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
