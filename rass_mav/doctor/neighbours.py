"""The links to the neighbours, and the nodes that are heard on them."""

from __future__ import annotations

from rass_mav.app.config import RunConfig
from rass_mav.link.airtime import MAX_TURN_S
from rass_mav.wire.codec import VERSION

from . import remedies, vehicle
from .finding import Finding, failed, passed, skipped, warned
from .watch import Evidence

#: This many own frames that come back within the few seconds of a check are a loop, not an accident.
LOOP = 5


def link(config: RunConfig, index: int, evidence: Evidence) -> Finding:
    """Is the link open?"""
    section = config.links[index]
    name = f"links[{index}]"
    if f"{name}.device" in evidence.blocked or (
        section.kind.through and ({"autopilot.url"} & (evidence.blocked | evidence.troubles.keys()))
    ):
        return skipped(name, "its port cannot be opened")
    if why := evidence.troubles.get(name):
        return failed(name, why, evidence.remedies.get(name, f"correct {name}"))
    state = evidence.link(index)
    if state is None:
        return failed(name, "the running node does not have it", "restart the node")
    if trouble := state["trouble"]:
        if section.kind.through:
            return skipped(name, "the autopilot's port is not open")
        remedy = (
            "is it still connected, and is no other program using it?"
            if section.kind.shared
            else f"see {name} address above"
        )
        return failed(name, f"{state['name']}: {trouble[0].lower()}{trouble[1:]}", remedy)
    text = f"{section.type} {state['name']}: open, {state['received']} frames or pieces received"
    if evidence.running:
        text += f", {state['sent']} sent"
        sent, dropped = evidence.grown(index, "sent"), evidence.grown(index, "dropped_out")
        if dropped > sent:
            return warned(
                name, f"{text}; during the check {dropped} could not be sent and {sent} could", "is the network up?"
            )
    return passed(name, text)


def hops(config: RunConfig, index: int) -> Finding:
    """Does "heard" mean "one hop away" on this link?"""
    section = config.links[index]
    name = f"links[{index}] hops"
    if section.direct:
        return passed(name, "nodes that are heard are one hop away")
    if section.only is not None:
        return passed(name, f"frames are forwarded; only nodes {', '.join(map(str, section.only))} are neighbours")
    return warned(
        name, "frames are forwarded on it, so a node that is heard may be many hops away",
        f"list the neighbours in links[{index}].only; or one_hop: true if all share one radio channel "
        "(docs/how-to/links.md)",
    )  # fmt: skip


def neighbours(config: RunConfig, evidence: Evidence) -> Finding | None:
    """Which nodes are heard? None: there are no links."""
    if not config.links:
        return None
    around = evidence.last["neighbours"]
    if not around and (why := no_way(config, evidence)):
        return skipped("neighbours", why)
    if not around:
        return warned(
            "neighbours", "nobody heard during the check",
            "is another node running, with the same port, network or radio channel? (links on slow radios take longer)",
        )  # fmt: skip
    names = ", ".join(f"{n['node_id']}{' (base)' if n['base'] else ''}" for n in around)
    other = [str(n["node_id"]) for n in around if not n["same_policy"]]
    if other:
        return warned(
            "neighbours", f"{names}; nodes {', '.join(other)} have another policy or other weights",
            "set the same section policy on all nodes",
        )  # fmt: skip
    if not config.is_base and not any(n["base"] or n["hops"] is not None for n in around):
        return warned("neighbours", f"{names}, but none knows a route to a base", "start the base")
    return passed("neighbours", names)


def no_way(config: RunConfig, evidence: Evidence) -> str:
    """Why no node can be heard, if another check reports it; empty: a node should be heard."""
    if not all(link.kind.through for link in config.links):
        return ""
    if not vehicle.is_heard(evidence):
        return "no autopilot"
    if vehicle.refuses(evidence):
        return "the autopilot ignores this node"
    forwarding = vehicle.forwarding(config, evidence)
    return "the autopilot forwards nothing" if forwarding is not None and forwarding.level == "fail" else ""


def signatures(evidence: Evidence) -> Finding | None:
    """Are the frames that are heard signed with this mission's keys? None: nobody checks."""
    if evidence.last["streams"] is None:
        return None
    key_updates = evidence.last.get("letters") or {"revoked": False, "out": []}
    if key_updates["revoked"]:
        return failed(
            "signatures", "the ground has revoked the keys of this drone",
            "if it is to fly again, give it new keys: rass-mav keys drone (docs/how-to/keys.md)",
        )  # fmt: skip
    unsigned, forged = (sum(evidence.grown(index, key) for index in evidence.opened) for key in ("unsigned", "forged"))
    if unsigned or forged:
        remedy = "if they are from nodes of this mission, give them its keys (docs/how-to/keys.md)"
        if out := [str(drone["node_id"]) for drone in key_updates["out"]]:
            many = "s" if len(out) > 1 else ""
            remedy = (
                f"drone{many} {', '.join(out)} {'are' if many else 'is'} revoked or replaced: what comes under "
                f"{'their' if many else 'its'} old keys is rightly ignored. Only if frames are from other nodes of "
                "this mission, give these its keys (docs/how-to/keys.md)"
            )
        return warned(
            "signatures", f"{unsigned} frames were ignored because they were not signed, and {forged} with other keys",
            remedy,
        )  # fmt: skip
    return passed("signatures", f"{evidence.last['streams']['known']} streams with this mission's keys")


def system_ids(evidence: Evidence) -> Finding:
    """Does every vehicle that is heard have its own system id?"""
    twins = (evidence.last["streams"] or {"twins": []})["twins"]
    if twins:
        return failed(
            "system ids", f"node {twins[0]['node_id']} has this node's system id {evidence.last['system_id']} and its "
            "component id, so the two take nothing from each other",
            remedies.for_system_id(evidence.firmware),
        )  # fmt: skip
    shared = evidence.last["shared_system_ids"]
    if not shared:
        return passed("system ids", f"{evidence.last['system_id']}, no two nodes that are heard share one")
    said = "; ".join(
        f"nodes {', '.join(map(str, one['node_ids']))} all use system id {one['system_id']}" for one in shared
    )
    return warned(
        "system ids", f"{said}, so a ground station sees them as one vehicle",
        remedies.for_system_id(evidence.firmware),
    )  # fmt: skip


def identity(config: RunConfig, evidence: Evidence) -> Finding:
    """Does another node have the same node id?"""
    rivals = evidence.last["rivals"]
    if rivals:
        return failed(
            "node id", f"another node with the id {config.node_id} is heard (life {rivals[0]['life']})",
            "give one of them another node.id",
        )  # fmt: skip
    return passed("node id", f"{config.node_id}, no other node with it was heard")


def versions(config: RunConfig, evidence: Evidence) -> Finding:
    """Do all nodes use this node's version of the wire format?"""
    # A node that was updated meanwhile no longer sends in the other version.
    others = [other for other in evidence.last["other_versions"] if other["age_s"] <= MAX_TURN_S]
    if not others:
        return passed("versions", f"only version {VERSION} of the wire format is heard")
    behind = {other["node_id"] if other["version"] < VERSION else config.node_id for other in others}
    said = ", ".join(f"node {other['node_id']} uses version {other['version']}" for other in others)
    return warned(
        "versions", f"{said}, this one {VERSION}; they accept no data from each other",
        f"update rass-mav on node {', '.join(map(str, sorted(behind)))} (docs/reference/protocol.md)",
    )  # fmt: skip


def loops(evidence: Evidence) -> Finding:
    """Do frames go round through two forwarders?"""
    first, last = evidence.samples[0]["copies"], evidence.last["copies"]
    echoes, copies = last["echoes"] - first["echoes"], last["heard_twice"] - first["heard_twice"]
    remedy = "turn forwarding off on one of the ports between the autopilots (docs/how-to/links.md)"
    if echoes >= LOOP:
        return failed("loops", f"{echoes} own frames came back during the check", remedy)
    if copies >= LOOP:
        return warned("loops", f"{copies} frames were heard twice during the check", remedy)
    return passed("loops", "no frames come twice")
