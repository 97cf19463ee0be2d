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
        return failed(name, "the running node has no such link", "restart the node")
    if trouble := state["trouble"]:
        if section.kind.through:
            return skipped(name, "the autopilot's port is not open")
        remedy = (
            "check that it is connected and that no other program uses it"
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
                name,
                f"{text}; during the check {sent} were sent and {dropped} could not be",
                "check that the network is up",
            )
    return passed(name, text)


def hops(config: RunConfig, index: int) -> Finding:
    """Does "heard" mean "one hop away" on this link?"""
    section = config.links[index]
    name = f"links[{index}] hops"
    if section.direct:
        return passed(name, "single-hop: every neighbour is in direct reach")
    if section.only is not None:
        return passed(name, f"the link forwards frames; only nodes {', '.join(map(str, section.only))} are neighbours")
    return warned(
        name, "the link forwards frames, so a neighbour may be many hops away",
        f"list the neighbours in links[{index}].only, or set one_hop: true if all share one radio channel "
        "(documentation: how-to/links)",
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
            "neighbours", "no node heard during the check",
            "check that another node uses the same port, network or radio channel (slow radios need more time)",
        )  # fmt: skip
    names = ", ".join(f"{n['node_id']}{' (base)' if n['base'] else ''}" for n in around)
    other = [str(n["node_id"]) for n in around if not n["same_policy"]]
    if other:
        return warned(
            "neighbours", f"{names}; nodes {', '.join(other)} use another policy or other weights",
            "use the same section policy on all nodes",
        )  # fmt: skip
    if not config.is_base and not any(n["base"] or n["hops"] is not None for n in around):
        return warned("neighbours", f"{names}, none with a route to a base", "start the base")
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


def signatures(config: RunConfig, evidence: Evidence) -> Finding | None:
    """Are the frames that are heard signed with this mission's keys? None: nobody checks."""
    if evidence.running and (evidence.last["streams"] is None) is not (config.keys is None):
        has, names = ("has keys", "none") if config.keys is None else ("has no keys", "some")
        return failed("signatures", f"the running node {has}, and the configuration names {names}", "restart the node")
    if evidence.last["streams"] is None:
        others = [str(n["node_id"]) for n in evidence.last["neighbours"] if n["keys"]]
        if not others:
            return None
        return warned(
            "signatures", f"nodes with keys ({', '.join(others)}) are heard; they ignore this one, which has none",
            "name its key file in keys.file (documentation: how-to/keys)",
        )  # fmt: skip
    key_updates = evidence.last.get("key_updates") or {"revoked": False, "others_revoked": []}
    if key_updates["revoked"]:
        return failed(
            "signatures", "the keys of this drone are revoked",
            "to fly it again, give it new keys: rass-mav keys drone --replace (documentation: how-to/keys)",
        )  # fmt: skip
    unsigned, forged = (sum(evidence.grown(index, key) for index in evidence.opened) for key in ("unsigned", "forged"))
    if unsigned or forged:
        remedy = (
            "if other nodes of this mission sent them, give those nodes the mission's keys (documentation: how-to/keys)"
        )
        if out := [str(drone["node_id"]) for drone in key_updates["others_revoked"]]:
            many = "s" if len(out) > 1 else ""
            remedy = (
                f"drone{many} {', '.join(out)} {'are' if many else 'is'} revoked or replaced: frames signed "
                f"with {'their' if many else 'its'} old keys are ignored, as intended. If other nodes of this mission "
                "sent them, give those nodes the mission's keys (documentation: how-to/keys)"
            )
        return warned(
            "signatures", f"ignored {unsigned} unsigned frames and {forged} signed with other keys",
            remedy,
        )  # fmt: skip
    return passed("signatures", f"{evidence.last['streams']['known']} senders with this mission's keys")


def system_ids(evidence: Evidence) -> Finding:
    """Does every vehicle that is heard have its own system id?"""
    twins = (evidence.last["streams"] or {"twins": []})["twins"]
    if twins:
        return failed(
            "system ids", f"node {twins[0]['node_id']} has this node's system id {evidence.last['system_id']} and its "
            "component id, so each ignores the other",
            remedies.for_system_id(evidence.firmware),
        )  # fmt: skip
    shared = evidence.last["shared_system_ids"]
    if not shared:
        return passed("system ids", f"{evidence.last['system_id']}, shared by no two neighbours")
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
            "node id", f"another node uses the id {config.node_id} (life {rivals[0]['life']})",
            "change node.id on one of them",
        )  # fmt: skip
    return passed("node id", f"{config.node_id}, used by no other node in range")


def versions(config: RunConfig, evidence: Evidence) -> Finding:
    """Do all nodes use this node's version of the wire format?"""
    # A node that was updated meanwhile no longer sends in the other version.
    others = [other for other in evidence.last["other_versions"] if other["age_s"] <= MAX_TURN_S]
    if not others:
        return passed("versions", f"only version {VERSION} of the wire format is heard")
    behind = {other["node_id"] if other["version"] < VERSION else config.node_id for other in others}
    said = ", ".join(f"node {other['node_id']} uses version {other['version']}" for other in others)
    return warned(
        "versions", f"{said}, this one {VERSION}; they do not exchange data",
        f"update rass-mav on node {', '.join(map(str, sorted(behind)))} (documentation: how-to/upgrade)",
    )  # fmt: skip


def loops(evidence: Evidence) -> Finding:
    """Do frames go round through two forwarders?"""
    first, last = evidence.samples[0]["copies"], evidence.last["copies"]
    echoes, copies = last["echoes"] - first["echoes"], last["heard_twice"] - first["heard_twice"]
    remedy = "turn forwarding off on one of the ports between the autopilots (documentation: how-to/links)"
    if echoes >= LOOP:
        return failed("loops", f"{echoes} frames of this node came back during the check", remedy)
    if copies >= LOOP:
        return warned("loops", f"{copies} frames were received twice during the check", remedy)
    return passed("loops", "no frame was received twice")
