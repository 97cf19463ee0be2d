"""All checks, in the order in which a person would do them."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from typing import Any, NamedTuple

from rass_mav.app.config import RunConfig, load_config
from rass_mav.errors import ConfigError

from . import computer, keys, neighbours, network, node, ports, radio, service, storage, vehicle, watch
from .finding import Finding, failed, passed
from .trial import try_out
from .watch import Evidence


class Report(NamedTuple):
    """The findings of all checks."""

    config: str
    node_id: int | None
    """None: the configuration could not be read."""
    running: bool
    """Whether the node was running, and was queried."""
    findings: tuple[Finding, ...]

    def count(self, level: str) -> int:
        """The number of findings of this level."""
        return sum(finding.level == level for finding in self.findings)

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "config": self.config,
            "node_id": self.node_id,
            "running": self.running,
            "checks": [
                {"name": f.name, "level": f.level, "text": f.text, "remedy": f.remedy or None} for f in self.findings
            ],
            "passed": self.count("pass"),
            "warned": self.count("warn"),
            "failed": self.count("fail"),
            "skipped": self.count("skip"),
        }


def check_up(path: str) -> Report:
    """Check a node, running or not. `path`: its configuration. Takes ten seconds at most."""
    name = service.name_of(path)
    findings = [computer.python(sys.version_info[:3], sys.executable)]
    try:
        config = load_config(path)
    except ConfigError as error:
        findings += [
            computer.packages(computer.needed_packages(None)),
            failed(
                "configuration",
                "; ".join(error.lines()),
                "rass-mav check reports the same (documentation: reference/configuration)"
                if os.path.isfile(path)
                else "check the path and the current folder",
            ),
            service.service(name),
        ]
        return Report(path, None, False, tuple(findings))
    findings += [
        computer.packages(computer.needed_packages(config)),
        passed("configuration", f"{path} is valid (node {config.node_id}, {config.node.role})"),
        service.service(name),
        computer.clock(time.time(), config.store_path),
        storage.store(config),
        keys.keys(config),
    ]
    serial = {port.key: ports.serial_port(port) for port in ports.serial_ports(config)}
    findings += serial.values()
    findings += [network.link_address(index, link) for index, link in enumerate(config.links) if not link.kind.shared]
    ways = [network.sending(index, link) for index, link in enumerate(config.links) if not link.kind.shared]
    findings += [finding for finding in ways if finding is not None]
    found, evidence, free = node.look(config)
    findings.append(found)
    if evidence is None and free:
        evidence = asyncio.run(try_out(config, watch.MOST_S))
    findings += (neighbours.hops(config, index) for index in range(len(config.links)))
    if evidence is not None:
        evidence.blocked = frozenset(key for key, finding in serial.items() if finding.level == "fail")
        findings += _seen(config, evidence, path)
    return Report(path, config.node_id, evidence is not None and evidence.running, tuple(findings))


def _seen(config: RunConfig, evidence: Evidence, path: str) -> list[Finding]:
    found = [
        vehicle.autopilot(config, evidence),
        vehicle.position(config, evidence),
        vehicle.reading(config, evidence),
        vehicle.forwarding(config, evidence),
        vehicle.parameters(config, evidence, path),
        radio.streams(config, evidence),
        *(neighbours.link(config, index, evidence) for index in range(len(config.links))),
        *(radio.radio(config, index, evidence) for index in range(len(config.links))),
        neighbours.neighbours(config, evidence),
        neighbours.versions(config, evidence),
        neighbours.loops(evidence),
        neighbours.identity(config, evidence),
        neighbours.system_ids(evidence),
        neighbours.signatures(config, evidence),
    ]
    return [finding for finding in found if finding is not None]
