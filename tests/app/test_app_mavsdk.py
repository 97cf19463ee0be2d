"""MAVSDK, an independent client, and a running node behind an autopilot."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable, Iterator
from contextlib import aclosing
from pathlib import Path
from typing import Any

import pytest

from rass_mav.station.parameters import INDEX
from tests.patience import PATIENCE_S

from .app_nodes import RunningNode, free_ports
from .app_relay import autopilot

pytest.importorskip("mavsdk.asyncio.mavsdk", reason="MAVSDK 4 is not installed (it is made for 64-bit computers only)")

from mavsdk.asyncio.mavsdk import Mavsdk
from mavsdk.asyncio.plugins.mavlink_direct.mavlink_direct import MavlinkDirectAsync
from mavsdk.asyncio.plugins.param.param import ParamAsync
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage
from mavsdk.plugins.param.param import ParamError, ParamResult, ProtocolVersion

SYSTEM, COMPANION = 12, 191


@pytest.fixture
def ground_port(tmp_path: Path) -> Iterator[int]:
    """Where the ground station has to listen: what a node and its autopilot say arrives there."""
    vehicle, link, ground = free_ports(3)
    node = RunningNode(
        tmp_path,
        7,
        autopilot={"url": f"udpin:127.0.0.1:{vehicle}"},
        # The ground station hears the swarm's frames as well.
        links=[{"listen": f"127.0.0.1:{link}", "peers": [{"address": f"127.0.0.1:{ground}"}]}],
        ground={"values_s": 1.0, "may_set_by_radio": True},
        policy={"name": "rass"},
    ).start()
    try:
        with autopilot(vehicle, ground, SYSTEM):
            yield ground
        assert node.signal(signal.SIGTERM) == 0
    finally:
        node.end()


class Station:
    """MAVSDK with the vehicle on it."""

    def __init__(self, system: Any) -> None:
        self.system = system
        self.param = ParamAsync(system)
        self.direct = MavlinkDirectAsync(system)

    async def hear(self, name: str, done: Callable[[dict[str, Any]], bool] = lambda fields: True) -> dict[str, Any]:
        """The next such message from the companion."""

        async def first() -> dict[str, Any]:
            async with aclosing(self.direct.subscribe_message(name)) as messages:
                async for message in messages:
                    fields: dict[str, Any] = json.loads(message.fields_json)
                    if (message.system_id, message.component_id) == (SYSTEM, COMPANION) and done(fields):
                        return fields
            raise AssertionError(f"no {name}")

        return await asyncio.wait_for(first(), PATIENCE_S)

    async def command(self, command: int, param1: float) -> None:
        fields: dict[str, float] = {
            "target_system": SYSTEM,
            "target_component": COMPANION,
            "command": command,
            "confirmation": 0,
        }
        fields |= {f"param{n}": 0.0 for n in range(2, 8)}
        message = MavlinkMessage("COMMAND_LONG", 245, 190, SYSTEM, COMPANION, json.dumps({**fields, "param1": param1}))
        await self.direct.send_message(message)


async def station(sdk: Any, port: int) -> Station:
    async with aclosing(sdk.on_new_system()) as changes:
        new = asyncio.ensure_future(anext(changes))
        await asyncio.sleep(0)  # so that it listens
        await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        while True:
            await asyncio.wait_for(new, PATIENCE_S)
            # Until the autopilot has been heard, the node speaks under an id of its own: that may come first.
            for system in await sdk.get_systems():
                if await system.get_system_id() == SYSTEM:
                    at = Station(system)
                    await at.hear("HEARTBEAT")
                    return at
            new = asyncio.ensure_future(anext(changes))


async def listed(param: Any) -> dict[str, float]:
    parameters = await param.get_all_params()
    assert parameters.int_params == []
    return {parameter.name: parameter.value for parameter in parameters.float_params}


async def test_mavsdk_reads_and_sets_our_parameters(ground_port: int) -> None:
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as sdk:
        at = await station(sdk, ground_port)
        try:
            await at.param.select_component(COMPANION, ProtocolVersion.V1)
        except ParamError as error:
            # Version 4.1 answers UNKNOWN and has selected it all the same, as the list shows.
            if error.result != ParamResult.UNKNOWN:
                raise
        values = await listed(at.param)
        assert set(values) == set(INDEX)
        assert (values["RASS_NODE_ID"], values["RASS_ALPHA"]) == (7.0, 1.0)
        assert await at.param.get_param_float("RASS_BETA") == 10.0

        await at.param.set_param_float("RASS_ALPHA", 2.5)
        assert await at.param.get_param_float("RASS_ALPHA") == 2.5
        assert (await listed(at.param))["RASS_ALPHA"] == 2.5

        said = asyncio.create_task(at.hear("STATUSTEXT", lambda f: f["text"].startswith("RASS_ALPHA: expected")))
        refused = asyncio.create_task(at.hear("PARAM_VALUE", lambda f: f["param_id"] == "RASS_ALPHA"))
        await asyncio.sleep(0)  # so that both listen
        with pytest.raises(ParamError):
            await at.param.set_param_float("RASS_ALPHA", -1.0)
        assert (await refused)["param_value"] == 2.5
        assert (await said)["severity"] == 4
        assert await at.param.get_param_float("RASS_ALPHA") == 2.5


async def test_mavsdk_sees_what_the_node_is_and_says(ground_port: int) -> None:
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as sdk:
        at = await station(sdk, ground_port)
        heartbeat = await at.hear("HEARTBEAT")
        assert (heartbeat["type"], heartbeat["autopilot"]) == (18, 8)  # onboard controller, no autopilot
        tunnel = await at.hear("TUNNEL")
        assert tunnel["payload_type"] == 33200
        assert 0 < tunnel["payload_length"] <= 128
        value = await at.hear("NAMED_VALUE_FLOAT", lambda f: f["name"] == "RASS_RISK")
        assert value["value"] == 1.0

        version = asyncio.create_task(at.hear("AUTOPILOT_VERSION"))
        ack = asyncio.create_task(at.hear("COMMAND_ACK", lambda f: f["command"] == 512))
        await asyncio.sleep(0)
        await at.command(512, 148)
        assert (await ack)["result"] == 0
        assert (await version)["capabilities"] & 131072
        ack = asyncio.create_task(at.hear("COMMAND_ACK", lambda f: f["command"] == 400))
        await asyncio.sleep(0)
        await at.command(400, 1)  # arm
        assert (await ack)["result"] == 3  # unsupported
