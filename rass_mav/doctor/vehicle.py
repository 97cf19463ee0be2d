"""The autopilot, what it sends, and the sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rass_mav.app.config import RunConfig
from rass_mav.mavlink.identity import AUTOPILOT_COMPONENT
from rass_mav.params.names import fitting_file, second_protocol, system_id_names
from rass_mav.params.ports import closed_ports, silent_ports
from rass_mav.station.ground import VALUE_NAMES

from . import remedies
from .finding import Finding, failed, passed, skipped, warned
from .watch import Evidence, heartbeats, positions, rate, readings, unfixed

#: An autopilot is heard if its last heartbeat is not older than this, seconds.
SILENT_S = 3.0
#: A rate that is lower than requested by this factor is too low.
_SLACK = 2.0


def is_heard(evidence: Evidence) -> bool:
    """Whether the node's own autopilot is heard. If not, `autopilot` reports why, and the other checks are skipped."""
    known, port = evidence.last["autopilot"], evidence.last["vehicle"] or {}
    return known is not None and known["heartbeat_age_s"] <= SILENT_S and not port.get("trouble")


def refuses(evidence: Evidence) -> bool:
    """Whether it signs its frames, or sends MAVLink 1, and does not answer us, because we do not sign."""
    known = evidence.last["autopilot"]
    return known is not None and known["signed"] is not False and known["version"] is None


def autopilot(config: RunConfig, evidence: Evidence) -> Finding:
    """Is the autopilot heard? Which one is it?"""
    url = config.autopilot.url
    if url is None:
        if config.is_base:
            return passed("autopilot", "none configured; a base needs none")
        return warned("autopilot", "none configured, so data carry no position", "set autopilot.url")
    if why := evidence.troubles.get("autopilot.url"):
        remedy = "another program may use the port: find it with ss -ulnp (documentation: how-to/autopilot)"
        return failed("autopilot", why, evidence.remedies.get("autopilot.url", remedy))
    known, firmware = evidence.last["autopilot"], evidence.firmware
    if not is_heard(evidence) or firmware is None:
        return _not_heard(url, config, evidence)
    words = [str(firmware), f"system {known['system_id']}", "armed" if known["armed"] else "disarmed"]
    per_second = rate(heartbeats(evidence.samples))
    if per_second is not None:
        words.append(f"{per_second:.1f} heartbeats/s")
    text = ", ".join(words)
    if known["signed"] is None:
        text = f"{text}; it sends MAVLink 1, which has no signatures"
        if refuses(evidence):
            return failed(
                "autopilot", f"{text}, and does not answer: it may accept only signed frames",
                second_protocol(firmware),
            )  # fmt: skip
        return warned("autopilot", text, second_protocol(firmware))
    if refuses(evidence):
        if config.autopilot.signing:
            return failed(
                "autopilot", f"{text}; its signatures are valid, but it does not answer",
                "restart the autopilot: it may have heard too many signed senders",
            )  # fmt: skip
        return failed(
            "autopilot", f"{text}; MAVLink signing is on, and it ignores this node's unsigned frames",
            remedies.for_signing(firmware),
        )  # fmt: skip
    values = evidence.parameters or {}
    for name in system_id_names(firmware):
        if values.get(name, known["system_id"]) != known["system_id"]:
            return warned(
                "autopilot", f"{text}; {name} is {values[name]:g}, but not in effect yet", "reboot the autopilot"
            )
    others = sorted((evidence.ear.autopilots.keys() if evidence.ear else set()) - {known["system_id"]})
    if others and not config.mavlink.autopilot_id:
        return warned(
            "autopilot", f"{text}; its port also carries systems {_list(others)}; the node uses the first one heard",
            "set mavlink.autopilot_id to the system id of this drone's autopilot",
        )  # fmt: skip
    if known["reboots"]:
        return warned("autopilot", f"{text}; it has restarted {known['reboots']} times", "check its power supply")
    return passed("autopilot", f"{text}, signed" if known["signed"] else text)


def _not_heard(url: str, config: RunConfig, evidence: Evidence) -> Finding:
    if "autopilot.url" in evidence.blocked:
        return skipped("autopilot", "its port cannot be opened")
    port = evidence.last["vehicle"] or {}
    if trouble := port.get("trouble"):
        if "in use by another program" in trouble:
            return failed(
                "autopilot", f"{url}: another program is using the port",
                "stop the other program, or share the port with a MAVLink router (documentation: how-to/autopilot)",
            )  # fmt: skip
        return failed("autopilot", f"{url}: {trouble.lower()}", "correct autopilot.url, or start the program there")
    if (why := _badly_signed(port.get("signing"))) is not None:
        return failed("autopilot", f"{url}: {why[0]}", why[1])
    heard = sorted(evidence.ear.autopilots) if evidence.ear is not None else []
    wanted = config.mavlink.autopilot_id
    if heard and wanted:
        return failed(
            "autopilot", f"no system {wanted} on {url}, but {_list(heard)}",
            "correct mavlink.autopilot_id, or the autopilot's system id (rass-mav params write --sysid)",
        )  # fmt: skip
    received = port.get("received", 0)
    if received and (evidence.ear.frames == 0 if evidence.ear else evidence.last["vehicle_malformed"]):
        return failed(
            "autopilot", f"the input from {url} is not MAVLink",
            "use the same speed in autopilot.url and on the autopilot's port, and MAVLink 2 on that port "
            "(ArduPilot: SERIALn_PROTOCOL 2; 5 (GPS) looks like a wrong speed); check the wires and the ground",
        )  # fmt: skip
    if received:
        return failed("autopilot", f"MAVLink comes from {url}, but no autopilot's heartbeat", "connect an autopilot")
    return failed(
        "autopilot", f"nothing heard on {url}",
        "check that it is on, that TX goes to RX and RX to TX, and that its port uses MAVLink 2 at the same speed "
        "(ArduPilot: SERIALn_PROTOCOL 2, and not -1 (none); documentation: how-to/autopilot)",
    )  # fmt: skip


def _badly_signed(refused: Mapping[str, int] | None) -> tuple[str, str] | None:
    """What is wrong with the signatures of frames that were refused, and what to do. None: none were."""
    if refused is None:
        return None
    if refused["forged"]:
        return (
            "heard, but its signatures are wrong: the autopilot and this drone have different keys",
            "stop the node and run rass-mav params signing at the autopilot's USB port",
        )
    if refused["mavlink_1"]:
        return (
            "heard, but it sends MAVLink 1, which has no signatures, and autopilot.signing is true",
            "set SERIALn_PROTOCOL 2 for this port (SERIAL2 is TELEM2), and reboot the autopilot",
        )
    if refused["unsigned"]:
        return (
            "heard, but without signatures, and autopilot.signing is true",
            "stop the node and run rass-mav params signing, or set autopilot.signing: false",
        )
    if refused["old"]:
        return (
            "heard, but its signatures are older than earlier ones",
            "restart the autopilot; if that does not help, an attacker is replaying its frames",
        )
    return None


def position(config: RunConfig, evidence: Evidence) -> Finding | None:
    """Do positions come, and often enough? None: there is no autopilot."""
    if config.autopilot.url is None or "autopilot.url" in evidence.troubles:
        return None
    firmware = evidence.firmware
    if not is_heard(evidence) or firmware is None:
        return skipped("position", "no autopilot")
    times = positions(evidence.samples)
    per_second = rate(times)
    remedy = remedies.for_positions(firmware)
    asked = config.autopilot.messages.get("GLOBAL_POSITION_INT")
    seldom = asked is not None and (per_second is None or per_second * asked * _SLACK < 1.0)
    if refuses(evidence) and seldom and not unfixed(evidence.samples):
        return skipped("position", "the autopilot ignores our requests")
    if not times:
        if unfixed(evidence.samples):
            return warned("position", "no fix yet", "wait, or move it under open sky")
        return warned("position", "none received", remedy)
    if per_second is None:
        return warned("position", "only one received during the check", remedy)
    if asked is not None and seldom:
        return warned("position", f"{per_second:.1f}/s, requested {1 / asked:.1f}/s", remedy)
    at = evidence.last["position"]
    return passed("position", f"{at['latitude']:.5f} {at['longitude']:.5f}, {per_second:.1f}/s")


def reading(config: RunConfig, evidence: Evidence) -> Finding:
    """Does the sensor answer, here or at the autopilot?"""
    if config.is_base:
        return passed("sensor", "a base needs none")
    if config.sensor.kind.handed_in and not evidence.running:
        return skipped("sensor", "programs can submit readings only while the node runs")
    own = config.sensor.own
    mavlink = config.mavlink
    sender = "" if mavlink.reading_component == AUTOPILOT_COMPONENT else f" of component {mavlink.reading_component}"
    named = f"NAMED_VALUE_FLOAT {mavlink.reading_name}{sender}"
    source = f"sensor {config.sensor.type}" if own else named
    if why := evidence.troubles.get("sensor"):
        return failed("sensor", why, "see documentation: how-to/sensors")
    last = evidence.last
    known = last["reading"]
    if known is None or known["age_s"] > config.risk.stale_s:
        return _unread(config, evidence, source)
    per_second = rate(readings(evidence.samples))
    text = f"{source}: {known['value']:g}, {known['age_s']:.1f} s old"
    if per_second is None:
        return warned(
            "sensor",
            text,
            f"readings are rare: set risk.stale_s ({config.risk.stale_s:g}) to at least twice their interval",
        )
    if per_second * config.risk.stale_s < _SLACK:
        return warned("sensor", f"{text}, {per_second:.2f}/s: fewer than two in risk.stale_s", "raise risk.stale_s")
    state = last["sensor"] or {}
    if state.get("malformed", 0) > state.get("readings", 0):
        return warned("sensor", f"{text}; most of its output cannot be decoded", "check sensor.baud and the wiring")
    return passed("sensor", f"{text}, {per_second:.1f}/s")


def _unread(config: RunConfig, evidence: Evidence, source: str) -> Finding:
    """Why there is no reading."""
    own, last = config.sensor.own, evidence.last
    what = "so the worst risk is assumed"
    if own and "sensor.port" in evidence.blocked:
        return skipped("sensor", "its port cannot be opened")
    if config.sensor.kind.handed_in:
        return failed("sensor", f"no program submits readings, {what}", "start it (documentation: integrate/programs)")
    if own:
        state = last["sensor"] or {}
        trouble = state.get("trouble") or ("the port is open but silent" if state else "")
        return failed(
            "sensor", f"no reading from {source}, {what}: {trouble}",
            "check that it is on, and check sensor.type and sensor.baud (documentation: how-to/sensors)",
        )  # fmt: skip
    if config.autopilot.url is None:
        return failed("sensor", f"no sensor and no autopilot, {what}", "set sensor.type or autopilot.url")
    firmware = evidence.firmware
    if "autopilot.url" in evidence.troubles or not is_heard(evidence) or firmware is None:
        return skipped("sensor", "no autopilot")
    if refuses(evidence):
        return skipped("sensor", "the autopilot ignores this node")
    why, remedy = remedies.for_readings(firmware, evidence.parameters)
    text = f"no {source} from the autopilot, {what}" + (f": {why}" if why else "")
    vehicle = last["autopilot"]["system_id"]
    heard = [
        f"{of['name']} of component {of['component_id']}"
        for of in last.get("ignored_readings", ())
        if of["system_id"] == vehicle and of["name"] not in VALUE_NAMES
    ]
    if heard:
        text += f"; received instead: {', '.join(heard)}"
        remedy += "; if one of these is the reading, set mavlink.reading_name and mavlink.reading_component"
    return failed("sensor", text, remedy)


def forwarding(config: RunConfig, evidence: Evidence) -> Finding | None:
    """Does the autopilot forward frames? None: there is no autopilot."""
    firmware = evidence.firmware
    if config.autopilot.url is None or not is_heard(evidence) or firmware is None or refuses(evidence):
        return None
    values = evidence.parameters
    if values is None:
        return skipped("forwarding", "stop the node to check it" if evidence.running else "no answer")
    closed = closed_ports(firmware, values)
    silent = silent_ports(firmware, values)
    if silent and not closed and through_autopilot(config) and not evidence.last["neighbours"]:
        named = ", ".join(f"{port.port} ({port.parameter} {port.value})" for port in silent)
        return warned(
            "forwarding", f"nothing is forwarded to {named}, which is not a MAVLink port, and no node is heard",
            f"if the radio is on that port, {remedies.for_closed_ports(silent)}",
        )  # fmt: skip
    if not closed:
        return passed("forwarding", "on for every MAVLink port of the autopilot")
    text = "off on " + ", ".join(f"{port.port} ({port.parameter} {port.value})" for port in closed)
    if not through_autopilot(config):
        return passed("forwarding", f"{text}; the swarm's frames do not use it")
    if evidence.last["neighbours"]:
        return passed("forwarding", f"{text}; neighbours are still heard")
    return failed(
        "forwarding", f"{text}, but the swarm's frames go through the autopilot", remedies.for_closed_ports(closed)
    )


def through_autopilot(config: RunConfig) -> bool:
    """Whether the neighbours are reached through the autopilot's radio."""
    return any(link.kind.through for link in config.links)


def parameters(config: RunConfig, evidence: Evidence, path: str) -> Finding | None:
    """Which parameter file matches this autopilot? None: unknown. `path`: the configuration's."""
    firmware = evidence.firmware
    if firmware is None or refuses(evidence) or (file := fitting_file(firmware)) is None:
        return None
    stop = "with the node stopped, " if evidence.running else ""
    return passed("parameters", f"not compared; {stop}run rass-mav params check {file} --live {path}")


def _list(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))
