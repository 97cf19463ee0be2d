"""The systemd service, if there is one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rass_mav.app.service import config_path, state, unit_path
from rass_mav.errors import ServiceError

from .finding import Finding, failed, passed, warned

#: How long to wait for systemd's answer, seconds.
ANSWER_S = 2.0
DEFAULT_NAME = "rass-mav"


def name_of(config: str) -> str:
    """The service that reads this configuration: /etc/NAME/node.yaml belongs to NAME."""
    path = Path(config).absolute()
    return path.parent.name if str(path) == config_path(path.parent.name) else DEFAULT_NAME


def service(name: str, ask: Callable[[str, float], dict[str, str]] = state, root: Path = Path("/")) -> Finding:
    """Is it running? A node can also be started by hand, so a missing service is not a fault.

    :param ask: returns systemd's properties of a service by name; raises `ServiceError`.
    """
    if not (root / unit_path(name).lstrip("/")).exists():
        return passed("service", f"{name} is not installed")
    look = f"journalctl -u {name} -n 30"
    try:
        properties = ask(name, ANSWER_S)
    except ServiceError as error:
        return warned("service", str(error), look)
    active = properties.get("ActiveState", "unknown")
    restarts = int(properties.get("NRestarts") or 0)
    if active != "active":
        return failed("service", f"{name} is {active}", f"{look}; sudo systemctl start {name}")
    if restarts:
        return warned("service", f"{name} is active, but was restarted {restarts} times", look)
    if properties.get("UnitFileState") != "enabled":
        return warned("service", f"{name} is active, but does not start at boot", f"sudo systemctl enable {name}")
    return passed("service", f"{name} is active and starts at boot")
