"""`python -m rass_mav.ground.commands.outputs`: what runs beside a base (`rass_mav.app.companion` starts it)."""

from __future__ import annotations

import logging
import sys

from rass_mav.commands.common import start_logging


def main() -> int:
    """The first line of standard input is a JSON object: the configuration, and the level of the log."""
    from rass_mav.app.config import RunConfig
    from rass_mav.app.jsonlines import load_line
    from rass_mav.config.typed import build
    from rass_mav.ground.outputs.process import work

    order = load_line(sys.stdin.buffer.readline())
    start_logging(0, logging.getLevelName(order["log"]))
    return work(build(order["config"], RunConfig))


if __name__ == "__main__":
    sys.exit(main())
