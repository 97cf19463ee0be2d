"""The form in which status and data are shown to people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rass_mav.config.keys import in_words

from .common import clean

#: Characters of the bar that shows how much of a file has arrived.
_BAR = 20


def status_lines(status: dict[str, Any]) -> Iterator[str]:
    """The answer of `status` in lines."""
    s = status
    yield f"node {s['node_id']} ({s['role']}), epoch {s['epoch']}, up {s['uptime_s']:.0f} s, {s['steps']} steps"
    yield from _keys(s)
    if s["role"] == "drone":
        way = f"{s['hop_count']} hops, next {s['next_hop']}" if s["hop_count"] is not None else "none"
        yield f"route to a base: {way}"
        unknown = "" if s["risk_known"] else " (unknown, counts as the worst)"
        yield f"risk {s['risk']:.3f}{unknown}, {_standing(s)}, policy {s['policy']}"
    yield from _readings(s)
    if s["position"] is not None:
        at = s["position"]
        yield f"position {at['latitude']:.7f} {at['longitude']:.7f} {at['altitude']:.1f} m, {at['age_s']:.1f} s old"
    store = s["store"]
    bound = "" if store["capacity_items"] is None else f" of {store['capacity_items']}"
    yield f"store: {store['items']}{bound} items, {store['bytes']} bytes"
    yield f"neighbours: {len(s['neighbours'])}"
    for n in s["neighbours"]:
        hops = "no route" if n["hops"] is None else f"{n['hops']} hops"
        standing = "base" if n["base"] else _standing(n)
        yield f"  node {n['node_id']}: {hops}, risk {n['risk']:.3f}, {standing}, heard {n['age_s']:.1f} s ago"
    straight = s["ground"]["link"] if s["ground"] else None
    for link in [*s["links"], *(way for way in (s["vehicle"], straight) if way)]:
        yield (
            f"link {link['name']}: {link['sent']} sent, {link['received']} received, "
            f"dropped {link['dropped_in']} in, {link['dropped_out']} out"
            + _ways(link.get("interfaces", ()))
            + _port_signatures(link.get("signing"))
        )
        if link["trouble"]:
            yield f"WARNING: link {link['name']}: {link['trouble']}"
    yield from _files(s["files"], s.get("watch"))
    yield "ledger: " + ", ".join(f"{name} {count}" for name, count in s["ledger"].items())
    if (beside := s.get("beside")) is not None:
        yield from _beside(beside)
    yield f"frames not understood: {s['malformed']} malformed, {s['foreign']} foreign"
    if s["commits"]["failed"]:
        yield f"WARNING: {s['commits']['failed']} commits failed"
    if s["faults"] and s["faults"]["count"]:
        last = s["faults"]["last"]
        yield (
            f"WARNING: {s['faults']['count']} frames hit a fault in this program and were dropped, the last one from "
            f"{last['sender']} {last['age_s']:.0f} s ago; please report it with the log"
        )
    for other in s["other_versions"]:
        yield (
            f"WARNING: node {other['node_id']} uses version {other['version']} of the wire format, "
            f"heard {other['age_s']:.0f} s ago"
        )
    for shared in s["shared_system_ids"]:
        nodes = ", ".join(map(str, shared["node_ids"]))
        yield f"WARNING: nodes {nodes} share system id {shared['system_id']}, a ground station sees one vehicle"
    if (streams := s.get("streams")) is not None:
        yield from _signatures(s, streams)
    for rival in s["rivals"]:
        yield f"WARNING: another node with this id, life {rival['life']}, heard {rival['age_s']:.0f} s ago"


def _readings(s: dict[str, Any]) -> Iterator[str]:
    """The last one, where they come from, and those that were not used."""
    from rass_mav.wire.measurement import UNIT_NAMES

    if s["reading"] is not None:
        reading = s["reading"]
        unit = "" if reading["unit"] is None else f" {UNIT_NAMES[reading['unit']]}"
        yield f"reading {reading['value']:g}{unit}, {reading['age_s']:.1f} s old"
    if (sensor := s["sensor"]) is not None:
        yield (
            f"sensor {sensor['name']}: {'open' if sensor['connected'] else 'not open'}, {sensor['readings']} readings, "
            f"{sensor['malformed']} malformed, {sensor['saturated']} saturated"
            + (f"; {sensor['trouble']}" if sensor["trouble"] else "")
        )
    for of in s.get("ignored_readings", ()):
        # What a vehicle sends under other names matters only where the reading is missing.
        if of["named"] or s["reading"] is None:
            yield clean(
                f"ignored: NAMED_VALUE_FLOAT {of['name']} of system {of['system_id']}, component {of['component_id']}, "
                f"{of['count']} times, the last {of['age_s']:.0f} s ago"
            )
    if (handed := s.get("handed_in")) is not None:
        refused = f"; {handed['refused']} refused, the last: {handed['last_refusal']}" if handed["refused"] else ""
        yield clean(f"handed in: {handed['readings']} readings, {handed['data']} of them data of their own{refused}")


def _files(files: Sequence[dict[str, Any]], watch: dict[str, Any] | None) -> Iterator[str]:
    """Those that are put, and the folder that is watched."""
    if watch is not None:
        yield clean(f"folder {watch['folder']}: {watch['put']} files put, {watch['waiting']} wait")
        if watch["trouble"]:
            yield clean(f"WARNING: folder {watch['folder']}: {watch['trouble']}")
    for file in files:
        created = f"{file['created']} of {file['parts']} parts created"
        arrived = "" if file["arrived"] is None else f", {file['arrived']} arrived"
        lost = f", {file['lost']} lost" if file["lost"] else ""
        damaged = ", the others are damaged on the disk" if file["damaged"] else ""
        done = file["handed_over"] if file["arrived"] is None else file["arrived"]
        bar = f"[{'#' * (_BAR * done // file['parts']):.<{_BAR}}]"
        yield clean(f"file {file['name']}: {bar} {created}, {file['handed_over']} handed over{arrived}{lost}{damaged}")


def _port_signatures(refused: dict[str, int] | None) -> str:
    """About the port of an autopilot with MAVLink signing. None: it is another link."""
    if refused is None:
        return ""
    ignored = ", ".join(f"{count} {how}" for how, count in refused.items() if count)
    return f"; signed{f', ignored {ignored}' if ignored else ''}"


def _keys(s: dict[str, Any]) -> Iterator[str]:
    """About keys, and changes of the link key."""
    yield in_words(s["keys"])
    if (key_updates := s.get("letters")) is None:
        return
    if key_updates["revoked"]:
        yield "WARNING: the ground has revoked the keys of this drone: no other node takes anything from it"
    if key_updates["kept"]:
        out = ", ".join(f"drone {drone['node_id']} to serial {drone['serial']}" for drone in key_updates["out"])
        yield f"key updates about link keys: of {key_updates['kept']} drones; revoked or replaced: {out or 'none'}"
    for drone in key_updates["out_elsewhere"]:
        yield f"WARNING: another copy of ground.keys has revoked or replaced drone {drone}, this one has not"


def _signatures(s: dict[str, Any], streams: dict[str, Any]) -> Iterator[str]:
    """About the frames of others, and whether they are signed rightly."""
    unsigned, forged = (sum(link[key] for link in s["links"]) for key in ("unsigned", "forged"))
    refused = streams["refused"]
    yield (
        f"signatures: {streams['known']} streams known; refused {unsigned} frames without one, {forged} with a wrong "
        f"one, {refused['strange']} of other streams, {refused['again'] + refused['late']} that came again or late"
    )
    for twin in streams["twins"]:
        yield (
            f"WARNING: node {twin['node_id']}, heard {twin['age_s']:.0f} s ago, has this node's system and component "
            "id, so this node takes nothing from it: change one of them (mavlink.system_id)"
        )


def _beside(beside: dict[str, Any]) -> Iterator[str]:
    """About the process beside a base."""
    if beside["pid"] is None:
        yield "WARNING: the process beside the node does not run; it is started again"
    if beside["ends"]:
        yield f"WARNING: the process beside the node has ended {beside['ends']} times; the log says why"
    for name in ("page", "metrics"):
        if (served := beside.get(name)) is not None and served["trouble"]:
            yield f"WARNING: {name}: {served['trouble']}"
    if (page := beside.get("page")) is not None and page["url"]:
        yield f"page: {page['url']}, {page['browsers']} open"
    if (hook := beside.get("on_arrival")) is not None:
        yield f"on_arrival: {hook['told']} told, {hook['failed']} failed, {hook['behind']} to come"
        if hook["last_failure"]:
            yield f"WARNING: on_arrival: the last failure: {hook['last_failure']}"
        if hook["trouble"]:
            yield f"WARNING: on_arrival: {hook['trouble']}"
    if (posted := beside.get("postgres")) is not None:
        state = "connected" if posted["connected"] else "not connected"
        yield f"postgres: {state}, {posted['posted']} data written, {posted['behind']} to come"
        if posted["trouble"]:
            yield f"WARNING: postgres: {posted['trouble']}"


def _ways(interfaces: Sequence[dict[str, Any]]) -> str:
    if not interfaces:
        return ""
    states = ((i["name"], "down" if not i["up"] else "up" if i["carrier"] else "no carrier") for i in interfaces)
    return "; " + ", ".join(f"{name} {state}" for name, state in states)


def _standing(s: dict[str, Any]) -> str:
    if "cost" in s:
        return "no route" if s["cost"] is None else f"cost {s['cost']:.4f}"
    return f"fitness {s['fitness']:.6f}"
