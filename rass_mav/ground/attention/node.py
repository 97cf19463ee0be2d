"""The conditions that a running node tells of itself, from its status. On a drone they are all that there is."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from rass_mav.core.alarms import Alarm

from .conditions import Condition, Level, condition

#: A position that is older is none, seconds.
_OLD_POSITION_S = 60.0
#: Alarms that the data in a base's store show too, with the drones.
_IN_STORE = {Alarm.TWO_CONTENTS, Alarm.UNKNOWN, Alarm.DAMAGED}


def of_node(status: dict[str, Any]) -> list[Condition]:
    """`status`: as `rass-mav status --json` prints it. What a node of another version does not say is left out."""
    known = defaultdict(lambda: None, status)
    parts = (_keys, _links, _work, _others, _outlets, _alarms, _drone)
    return [found for part in parts for found in part(known)]


def _warn(title: str, do: str = "", detail: str = "", level: Level = Level.WARNING) -> Condition:
    return Condition(level, "node", None, title, None, do, detail)


def _keys(s: dict[str, Any]) -> Iterator[Condition]:
    updates = s["key_updates"]
    if updates is None:
        return
    if updates["revoked"]:
        yield _warn(
            "the keys of this drone are revoked: other nodes ignore it",
            "Give it new keys, or recover its card.", level=Level.ALARM,
        )  # fmt: skip
    for drone in updates["revoked_elsewhere"]:
        yield _warn(
            f"another copy of ground.keys has revoked or replaced drone {drone}, this one has not",
            "Copy the newer file to all bases.",
        )


def _links(s: dict[str, Any]) -> Iterator[Condition]:
    straight = s["ground"]["link"] if s["ground"] else None
    for link in [*(s["links"] or ()), *(way for way in (s["vehicle"], straight) if way)]:
        if link["trouble"]:
            yield _warn(f"link {link['name']}: {link['trouble']}")
    if (watch := s["watch"]) is not None and watch["trouble"]:
        yield _warn(f"folder {watch['folder']}: {watch['trouble']}")


def _work(s: dict[str, Any]) -> Iterator[Condition]:
    if s["commits"] and s["commits"]["failed"]:
        yield _warn(f"{s['commits']['failed']} commits failed", "Check the disk, and see the log.")
    if s["faults"] and s["faults"]["count"] and s["faults"].get("last"):
        last = s["faults"]["last"]
        yield _warn(
            f"{s['faults']['count']} frames triggered a fault here and were dropped, the last one from "
            f"{last['sender']} {last['age_s']:.0f} s ago",
            "Please report it with the log.",
        )


def _others(s: dict[str, Any]) -> Iterator[Condition]:
    for other in s["other_versions"] or ():
        yield _warn(
            f"node {other['node_id']} uses version {other['version']} of the wire format, "
            f"heard {other['age_s']:.0f} s ago",
            "Update the older one.",
        )
    for shared in s["shared_system_ids"] or ():
        nodes = ", ".join(map(str, shared["node_ids"]))
        yield _warn(f"nodes {nodes} share system id {shared['system_id']}, a ground station sees one vehicle")
    for twin in (s["streams"] or {}).get("twins", ()):
        yield _warn(
            f"node {twin['node_id']}, heard {twin['age_s']:.0f} s ago, has this node's system and component "
            "id, so this node ignores it",
            "Change one of them (mavlink.system_id).",
        )
    for rival in s["rivals"] or ():
        yield _warn(
            f"another node with this id, life {rival['life']}, heard {rival['age_s']:.0f} s ago",
            "Give one of them another node.id.",
        )


def _outlets(s: dict[str, Any]) -> Iterator[Condition]:
    """About the output process of a base."""
    if (outputs := s["outputs"]) is None:
        return
    if outputs["pid"] is None:
        yield _warn("the output process is not running; it will be restarted")
    if outputs["ends"]:
        yield _warn(f"the output process has ended {outputs['ends']} times; see the log")
    for name in ("page", "metrics", "on_arrival", "postgres", "cot"):
        if (served := outputs.get(name)) is None:
            continue
        if served.get("last_failure"):
            yield _warn(f"{name}: the last failure: {served['last_failure']}")
        if served["trouble"]:
            yield _warn(f"{name}: {served['trouble']}")


def _alarms(s: dict[str, Any]) -> Iterator[Condition]:
    for alarm in Alarm:
        count = (s["alarms"] or {}).get(alarm.name.lower(), 0)
        if count and not (s["role"] == "base" and alarm in _IN_STORE):
            yield _warn(f"{alarm.value}, {count} times since the start")


def _drone(s: dict[str, Any]) -> Iterator[Condition]:
    """What a drone tells in its statuses too, where they arrive."""
    if s["role"] != "drone":
        return
    found = []
    if s["hop_count"] is None:
        found.append(condition("no route"))
    if s["autopilot"] is not None and (s["position"] is None or s["position"]["age_s"] > _OLD_POSITION_S):
        found.append(condition("position"))
    if (s["autopilot"] is not None or s["sensor"] is not None) and not s["risk_known"]:
        found.append(condition("sensor", detail="" if s["sensor"] is None else s["sensor"]["trouble"]))
    store = s["store"]
    if store["capacity_items"] is not None and store["items"] - store["replicas"] >= store["capacity_items"]:
        found.append(condition("full"))
    yield from found
    if s["clock"] and not s["clock"]["trusted"]:
        yield _warn("this node does not know the date", "Data keep their ages. Connect a GPS or NTP.", level=Level.NOTE)
    for neighbour in s["neighbours"] or ():
        if neighbour.get("suspected"):
            text = f"node {neighbour['node_id']} accepts data that do not arrive"
            yield _warn(text, "It gets few data until some arrive.")
