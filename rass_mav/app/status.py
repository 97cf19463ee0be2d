"""The contents of `rass-mav status` (docs/reference/configuration.md)."""

from __future__ import annotations

import os
from collections import defaultdict
from typing import Any

from rass_mav import __version__
from rass_mav.core.messages import NO_ROUTE
from rass_mav.core.policy import POTENTIAL_ONE, Policy
from rass_mav.core.routes.costs import COST_ONE, NO_COST
from rass_mav.core.routes.neighbours import Neighbour, is_base
from rass_mav.link.vehicle import VehiclePort
from rass_mav.store.quota import ROW_OVERHEAD

from .driver import Driver

#: The version of the interface for other programs (docs/integrate/programs.md).
INTERFACE = 1


def status(driver: Driver, started: float) -> dict[str, Any]:
    """The state of a running node as plain values. Ages and times in seconds; null: unknown or none.

    `started`: when the node was started, on the driver's timeline.
    """
    agent = driver.agent
    node, telemetry, settings = agent.node, agent.telemetry, agent.settings
    routing = node.routing
    now = driver.now()
    route = routing.route
    reading, position = agent.last_reading, telemetry.position
    heartbeat = telemetry.heartbeat_at
    check = agent.vehicle_reader.check
    return {
        "node_id": node.id,
        "role": "base" if node.base else "drone",
        "system_id": agent.peers.writer.system_id,
        "version": __version__,
        "interface": INTERFACE,
        "pid": os.getpid(),
        "life": f"{node.store.life:08x}",
        "epoch": f"{node.store.epoch:08x}",
        "uptime_s": round(now - started, 3),
        "steps": agent.steps,
        "skipped_steps": driver.steps.skipped,
        "step_s": settings.step_s,
        "step_age_s": None if driver.steps.last is None else round(now - driver.steps.last, 3),
        "clock": None
        if driver.lived is None
        else {"lived_s": round(now, 3), "trusted": driver.lived.trusted, "off_known": driver.lived.off_known},
        "policy": settings.policy.name,
        "hop_count": None if routing.hops == NO_ROUTE else routing.hops,
        "next_hop": routing.next_hop,
        "base": None if route is None else {"node_id": route.base, "life": f"{route.base_life:08x}"},
        "risk": node.risk.risk(now),
        "risk_known": node.risk.known(now),
        **_potential(node.potential, node.base, node.policy.costs is not None),
        "reading": None
        if reading is None
        else {"value": reading.value, "unit": agent.unit_of(reading), "age_s": round(now - reading.at, 3)},
        "ignored_readings": [
            {
                "system_id": system,
                "component_id": component,
                "name": name,
                "count": of.times,
                "age_s": round(now - of.at, 3),
                "named": name == settings.mavlink.reading_name,
            }
            for (system, component, name), of in telemetry.ignored.items()
        ],
        "sensor": None if driver.sensor is None else {"name": driver.sensor.name, **driver.sensor.state()._asdict()},
        "position": None
        if position is None
        else {
            "latitude": position.latitude,
            "longitude": position.longitude,
            "altitude": position.altitude,
            "age_s": round(now - position.at, 3),
        },
        "autopilot": None
        if heartbeat is None
        else {
            "system_id": telemetry.system_id,
            "type": telemetry.autopilot,
            "version": None if telemetry.version is None else list(telemetry.version.version),
            "signed": telemetry.signed,
            "heartbeat_age_s": round(now - heartbeat, 3),
            "armed": telemetry.armed,
            "reboots": telemetry.reboots,
            "no_fix_age_s": None if telemetry.no_fix_at is None else round(now - telemetry.no_fix_at, 3),
        },
        "neighbours": [
            {**_neighbour(n, now, node.policy), "system_id": agent.peers.system_ids.get(n.id)}
            for n in sorted(routing.neighbours.values(), key=_id)
        ],
        "shared_system_ids": _shared_system_ids(driver),
        **agent.trust.report(now),
        "store": _store(driver),
        "ledger": {**node.store.counters(), **node.figures()},
        "commits": {
            "done": driver.writer.gate.commits,
            "failed": driver.writer.gate.failures,
            "frames_waiting": driver.writer.gate.waiting,
            "frames_dropped": driver.writer.gate.dropped,
        },
        "links": [
            {
                "name": channel.link.name,
                "trouble": channel.link.trouble or None,
                "one_hop": channel.link.one_hop,
                "interfaces": [way._asdict() for way in channel.link.carriers()],
                **channel.link.counters()._asdict(),
                **channel.link.report(),
                **channel.link_queue.report(),
            }
            for channel in driver.channels
        ],
        "copies": {"heard_twice": driver.duplicates.heard_twice, "echoes": driver.duplicates.echoes},
        "vehicle": None
        if driver.vehicle is None
        else {**_port(driver.vehicle), "signing": None if check is None else check.report()},
        "ground": None
        if agent.ground is None
        else {
            "link": None if driver.ground is None else _port(driver.ground),
            **agent.ground.report(),
        },
        "malformed": agent.peers.malformed + sum(channel.link_queue.reader.malformed for channel in driver.channels),
        "foreign": agent.peers.foreign,
        "other_versions": [
            {"node_id": node_id, "version": other.version, "age_s": round(now - other.heard, 3)}
            for node_id, other in sorted(agent.peers.other_versions.items())
        ],
        "vehicle_malformed": agent.vehicle_reader.malformed,
        "faults": agent.guard.report(now),
        "alarms": {alarm.name.lower(): count for alarm, count in node.alarms.counts.items()},
        "rivals": [
            {"life": f"{life:08x}", "age_s": round(now - at, 3)} for life, at in sorted(node.alarms.rivals.items())
        ],
    }


def _id(neighbour: Neighbour) -> int:
    return neighbour.id


def _potential(potential: int, base: bool, costs: bool) -> dict[str, float | None]:
    """The policy's criterion: the paper's phi (None for a base, which is fitter than any drone), or with `costs` the
    cost of the route (0 for a base, None: neither route nor shelter)."""
    if costs:
        return {"cost": 0.0 if base else None if potential >= NO_COST else potential / COST_ONE}
    return {"fitness": None if base else potential / POTENTIAL_ONE}


def _neighbour(neighbour: Neighbour, now: float, policy: Policy) -> dict[str, Any]:
    beacon = neighbour.beacon
    return {
        "node_id": neighbour.id,
        "base": is_base(beacon),
        "hops": None if beacon.hops == NO_ROUTE else beacon.hops,
        "risk": beacon.risk / 65535,
        **_potential(beacon.potential, is_base(beacon), policy.costs is not None),
        "free_items": beacon.free,
        "same_policy": beacon.policy == policy.tag,
        "keys": bool(beacon.key or beacon.proof),
        "suspected": neighbour.suspected,
        "age_s": round(now - neighbour.heard, 3),
    }


def _shared_system_ids(driver: Driver) -> list[dict[str, Any]]:
    """System ids that several nodes use, among the neighbours and this node."""
    agent = driver.agent
    users: dict[int, list[int]] = defaultdict(list)
    for node_id in agent.node.routing.neighbours:
        if (system_id := agent.peers.system_ids.get(node_id)) is not None:
            users[system_id].append(node_id)
    # The node's own id may still change until its autopilot has been heard.
    if driver.vehicle is None or agent.telemetry.system_id or agent.settings.mavlink.system_id is not None:
        users[agent.peers.writer.system_id].append(agent.node.id)
    return [
        {"system_id": system_id, "node_ids": sorted(node_ids)}
        for system_id, node_ids in sorted(users.items())
        if len(node_ids) > 1
    ]


def _port(port: VehiclePort) -> dict[str, Any]:
    return {"name": port.name, "trouble": port.trouble or None, **port.counters()._asdict()}


def _store(driver: Driver) -> dict[str, Any]:
    node, settings = driver.agent.node, driver.agent.settings.store
    items = len(list(node.store.ids()))
    return {
        "items": items,
        "replicas": len(node.holdings) - len(node.holdings.custody),
        "bytes": node.store.used_bytes - items * ROW_OVERHEAD,
        "capacity_items": node.holdings.capacity_items,
        "capacity_bytes": None if node.sink else settings.capacity_bytes,
        "quota_bytes": node.store.quota_bytes,
    }
