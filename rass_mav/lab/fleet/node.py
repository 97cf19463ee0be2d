"""`python -m rass_mav.lab.fleet.node CONFIG NAME...`: `rass-mav run CONFIG --json`, without these mechanisms.

No configuration can leave a mechanism out. A swarm of processes does it here. The node ends when its stdin does.
"""

from __future__ import annotations

import json
import sys
from dataclasses import fields, replace
from typing import Any

from rass_mav.agent.settings import AgentSettings
from rass_mav.app.config import RunConfig, load_config
from rass_mav.app.run import Runtime
from rass_mav.core.settings import Mechanism
from rass_mav.errors import RassError
from rass_mav.lab.fleet.tether import end_with_stdin


class LesserConfig(RunConfig):
    """The configuration of a node that lacks something."""

    without: tuple[Mechanism, ...] = ()

    def agent_settings(self) -> AgentSettings:
        """The settings that the agent needs."""
        return replace(super().agent_settings(), without=self.without)


def main(path: str, without: tuple[Mechanism, ...]) -> None:
    """Run the node until SIGTERM. One line on stdout says that it is ready."""
    config = load_config(path)
    sections: dict[str, Any] = {field.name: getattr(config, field.name) for field in fields(config)}
    announced = False

    def ready(about: dict[str, Any]) -> None:
        nonlocal announced
        if not announced:
            sys.stdout.write(json.dumps(about) + "\n")
            sys.stdout.flush()
        announced = True

    Runtime(LesserConfig(**sections, without=without), ready).run()


if __name__ == "__main__":
    end_with_stdin()
    try:
        main(sys.argv[1], tuple(sys.argv[2:]))  # type: ignore[arg-type]  # the scenario's names are checked
    except RassError as error:
        sys.exit(str(error))
