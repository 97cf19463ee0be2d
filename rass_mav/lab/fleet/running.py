"""A `rass-mav run` as a child process."""

from __future__ import annotations

from pathlib import Path

from rass_mav.app.jsonlines import load_line
from rass_mav.lab.fleet.children import Child, Children


class RunningNode:
    """One node: its files and its process."""

    def __init__(self, node_id: int, directory: Path, socket: Path, stem: str) -> None:
        """`directory`: for configuration, store and log, whose names begin with `stem`. `socket`: of the control
        socket, at most 107 bytes."""
        self.node_id = node_id
        self.name = f"node {node_id}"
        self.config = directory / f"{stem}.yaml"
        self.store = directory / f"{stem}.db"
        self.log = directory / f"{stem}.log"
        self.socket = socket
        self.ready = False
        self.child: Child

    def start(self, children: Children) -> None:
        """Start the process. The node runs when it is `ready`."""
        self.ready = False
        self.child = children.start(self.name, self._arguments(), self.log, self.heard)

    def _arguments(self) -> list[str]:
        """What Python runs."""
        return ["-m", "rass_mav.lab.fleet.tether", "run", str(self.config), "--json"]

    def heard(self) -> None:
        """Read its stdout: the line that reports it ready, or the end. Raises `SwarmError`."""
        self.child.read()
        line = self.child.next_line()
        if line is not None:
            # If it could not start, it reports the reason on stderr too, and the end of its output follows.
            self.ready = "error" not in load_line(line)
