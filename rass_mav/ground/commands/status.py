"""`status`: what a running node knows, and first what needs attention: of the node, and at a base of all drones."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.commands.common import Subparsers, add_command, add_socket, answer, clean, client_of, config_of
from rass_mav.config.keys import in_words
from rass_mav.errors import RassError

if TYPE_CHECKING:
    from rass_mav.ground.attention.conditions import Condition
    from rass_mav.ground.attention.watch import Watch
    from rass_mav.ground.follow import Follower

#: Seconds between two looks with --watch.
WATCH_S = 1.0
# To the top left corner, and clear the screen.
_CLEAR = "\x1b[H\x1b[2J"
#: Characters of the bar that shows how much of a file has arrived.
_BAR = 20


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    status = add_command(
        subparsers, "status", _status, help="show the state of the running node, and what needs attention",
        example="rass-mav status drone.yaml --json",
    )  # fmt: skip
    status.add_argument(
        "--watch", action="store_true", help="refresh every second, until Ctrl-C; with --json one object per line"
    )  # fmt: skip
    status.add_argument("config", metavar="CONFIG.yaml", nargs="?", help="the node's configuration")
    add_socket(status)


def _status(options: argparse.Namespace) -> int:
    from rass_mav.ground.attention.conditions import MOST_LISTED, in_order
    from rass_mav.ground.attention.node import of_node

    arrived: Follower[Watch] | str | None = None
    with client_of(options) as client:
        while True:
            status = client.ask("status")["status"]
            now = time.time()
            found = of_node(status)
            if status["role"] == "base":
                # What it takes to read the store is read once.
                arrived = _followed(options, client.path) if arrived is None else arrived
                found += _of_drones(arrived, now)
            found = in_order(found)
            if options.watch and not options.json and sys.stdout.isatty():
                sys.stdout.write(_CLEAR)
            attention = {"attention": [one.plain(now) for one in found[:MOST_LISTED]]}
            answer(options, {**status, **attention}, (*_attention(found, now), *status_lines(status)))
            if not options.watch:
                return 0
            sys.stdout.flush()
            time.sleep(WATCH_S)


def _followed(options: argparse.Namespace, socket: Path) -> Follower[Watch] | str:
    """What has arrived at a base; or why that cannot be read."""
    from rass_mav.ground.archive import Archive, opener_of_node
    from rass_mav.ground.attention.rules import RuleBook
    from rass_mav.ground.attention.watch import Watch
    from rass_mav.ground.follow import Follower

    try:
        if options.config is None:
            # The usual name; without the configuration there are no keys.
            store, opens, rules = socket.with_suffix(".db"), None, RuleBook()
        else:
            config = config_of(options)
            store, opens, rules = config.store_path, opener_of_node(config), RuleBook.of(config)
        return Follower(lambda: Archive(store, salvage=False, opens=opens), Watch, rules)
    except RassError as error:
        return " ".join(error.lines())


def _of_drones(arrived: Follower[Watch] | str, now: float) -> list[Condition]:
    from rass_mav.ground.attention.conditions import Condition, Level

    trouble = arrived if isinstance(arrived, str) else ""
    if not isinstance(arrived, str):
        arrived.look()
        while arrived.behind:
            arrived.look()
        trouble = arrived.trouble
    if trouble or isinstance(arrived, str):
        return [Condition(Level.WARNING, "node", None, f"nothing is known of the drones: {trouble}", None, "")]
    return arrived.mission.conditions(now, arrived.date)


def _attention(found: Iterable[Condition], now: float) -> Iterator[str]:
    from rass_mav.ground.attention.conditions import rows

    for row in rows(found, now):
        yield clean(row.line)


def status_lines(status: dict[str, Any]) -> Iterator[str]:
    """The answer of `status` in lines."""
    s = status
    yield f"node {s['node_id']} ({s['role']}), epoch {s['epoch']}, up {s['uptime_s']:.0f} s, {s['steps']} steps"
    yield from _keys(s)
    if s["role"] == "drone":
        way = f"{s['hop_count']} hops, next {s['next_hop']}" if s["hop_count"] is not None else "none"
        yield f"route to a base: {way}"
        unknown = "" if s["risk_known"] else " (unknown: the worst is assumed)"
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
        standing = "base" if n["base"] else f"risk {n['risk']:.3f}, {_standing(n)}"
        yield f"  node {n['node_id']}: {hops}, {standing}, heard {n['age_s']:.1f} s ago"
    straight = s["ground"]["link"] if s["ground"] else None
    for link in [*s["links"], *(way for way in (s["vehicle"], straight) if way)]:
        yield (
            f"link {link['name']}: {link['sent']} sent, {link['received']} received, "
            f"dropped {link['dropped_in']} in, {link['dropped_out']} out"
            + _ways(link.get("interfaces", ()))
            + _port_signatures(link.get("signing"))
        )
    yield from _files(s["files"], s.get("watch"))
    yield "ledger: " + ", ".join(f"{name} {count}" for name, count in s["ledger"].items())
    if (outputs := s.get("outputs")) is not None:
        yield from _outputs(outputs)
    yield f"frames not decoded: {s['malformed']} malformed, {s['foreign']} foreign"
    if (streams := s.get("streams")) is not None:
        yield from _signatures(s, streams)


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
        # What a vehicle sends under other names matters only where the reading is missing. Some repeat what we send.
        if of["named"] or (s["reading"] is None and not of["name"].startswith("RASS_")):
            yield clean(
                f"ignored: NAMED_VALUE_FLOAT {of['name']} of system {of['system_id']}, component {of['component_id']}, "
                f"{of['count']} times, the last {of['age_s']:.0f} s ago"
            )
    if (handed := s.get("handed_in")) is not None:
        refused = f"; {handed['refused']} refused, the last: {handed['last_refusal']}" if handed["refused"] else ""
        yield clean(f"submitted: {handed['readings']} readings, {handed['data']} of them as separate data{refused}")


def _files(files: Sequence[dict[str, Any]], watch: dict[str, Any] | None) -> Iterator[str]:
    """Those that are put, and the folder that is watched."""
    if watch is not None:
        yield clean(f"folder {watch['folder']}: {watch['put']} files sent, {watch['waiting']} waiting")
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
    if (key_updates := s.get("key_updates")) is None:
        return
    if key_updates["drones"]:
        revoked = key_updates["others_revoked"]
        named = ", ".join(f"drone {drone['node_id']} up to serial {drone['serial']}" for drone in revoked)
        yield f"key updates: for {key_updates['drones']} drones; revoked or replaced: {named or 'none'}"


def _signatures(s: dict[str, Any], streams: dict[str, Any]) -> Iterator[str]:
    """About the frames of others, and whether they are signed rightly."""
    unsigned, forged = (sum(link[key] for link in s["links"]) for key in ("unsigned", "forged"))
    refused = streams["refused"]
    late = refused["repeated"] + refused["late"]
    yield (
        f"signatures: {streams['known']} streams verified; ignored {unsigned} unsigned frames, {forged} with a wrong "
        f"signature, {refused['unverified']} of unverified streams, {late} repeated or late"
    )


def _outputs(outputs: dict[str, Any]) -> Iterator[str]:
    """About the output process of a base."""
    if (page := outputs.get("page")) is not None and page["url"]:
        yield f"page: {page['url']}, {page['browsers']} open"
    if (hook := outputs.get("on_arrival")) is not None:
        yield f"on_arrival: {hook['succeeded']} done, {hook['failed']} failed, {hook['behind']} pending"
    if (posted := outputs.get("postgres")) is not None:
        state = "connected" if posted["connected"] else "not connected"
        yield f"postgres: {state}, {posted['posted']} data written, {posted['behind']} pending"
    if (cot := outputs.get("cot")) is not None:
        yield f"cot: {cot['url']}, {'connected' if cot['connected'] else 'not connected'}, {cot['sent']} events sent"


def _ways(interfaces: Sequence[dict[str, Any]]) -> str:
    if not interfaces:
        return ""
    states = ((i["name"], "down" if not i["up"] else "up" if i["carrier"] else "no carrier") for i in interfaces)
    return "; " + ", ".join(f"{name} {state}" for name, state in states)


def _standing(s: dict[str, Any]) -> str:
    if "cost" in s:
        return "no route" if s["cost"] is None else f"cost {s['cost']:.4f}"
    return f"fitness {s['fitness']:.6f}"
