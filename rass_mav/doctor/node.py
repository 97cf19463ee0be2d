"""The running node, queried through its control socket."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from rass_mav.app.client import ControlClient
from rass_mav.app.config import RunConfig
from rass_mav.errors import ControlError

from . import watch
from .finding import Finding, failed, passed, warned
from .watch import LOOK_S, Evidence, Status, seen_enough

#: How long to wait for the node's answer, seconds.
ANSWER_S = 2.0


def look(
    config: RunConfig, clock: Callable[[], float] = time.monotonic, pause: Callable[[float], None] = time.sleep
) -> tuple[Finding, Evidence | None, bool]:
    """Whether the node is running, what was seen of it, and whether its ports are free for a trial.

    :param clock: returns seconds. `pause`: waits for this many seconds.
    """
    path = config.socket_path
    if not os.path.lexists(path):
        return (
            passed(
                "node", f"not running (no {path}); its ports were opened for this check, nothing was sent to neighbours"
            ),
            None,
            True,
        )
    if not os.access(path, os.R_OK | os.W_OK, effective_ids=os.access in os.supports_effective_ids):
        owner = _owner(path)
        return failed("node", f"{path} belongs to {owner}", f"run this as that user: sudo -u {owner} ..."), None, False
    try:
        client = ControlClient(path, timeout_s=ANSWER_S)
    except ControlError:
        text = f"not running: it was killed (it left {path} behind); its ports were opened for this check"
        return passed("node", text), None, True
    samples: list[Status] = []
    began = clock()
    try:
        with client:
            while not samples or (clock() - began < watch.MOST_S and not seen_enough(config, samples)):
                if samples:
                    pause(LOOK_S)
                samples.append(client.ask("status")["status"])
    except ControlError as error:
        if not samples:
            return failed("node", str(error), "see its log, then restart it"), None, False
    evidence = Evidence(True, samples, opened=list(range(len(samples[-1]["links"]))))
    return health(config, evidence), evidence, False


def health(config: RunConfig, evidence: Evidence) -> Finding:
    """The state of the running node."""
    first, last = evidence.samples[0], evidence.last
    about = f"running: node {last['node_id']} ({last['role']}), process {last['pid']}, up {last['uptime_s']:.0f} s"
    if (last["node_id"], last["role"]) != (config.node_id, config.node.role):
        return failed(
            "node", f"{about}, but the configuration is for node {config.node_id} ({config.node.role})",
            "restart it with this configuration, or check the one it was started with",
        )  # fmt: skip
    if len(last["links"]) != len(config.links):
        return failed(
            "node", f"{about}, with {len(last['links'])} links, but {len(config.links)} are configured", "restart it"
        )
    if last["commits"]["failed"] > first["commits"]["failed"]:
        return failed("node", f"{about}; it cannot write to its disk", "see its log, and check the disk")
    if last["commits"]["failed"]:
        return warned("node", f"{about}; {last['commits']['failed']} commits failed earlier", "see its log")
    if last["skipped_steps"] > first["skipped_steps"]:
        return warned("node", f"{about}; it skips steps", "the computer is too slow or too busy: raise node.step_s")
    return passed("node", about)


def _owner(path: Path) -> str:
    try:
        return path.owner()
    except (OSError, KeyError):
        return "another user"
