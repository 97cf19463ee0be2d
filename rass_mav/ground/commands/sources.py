"""`sources`: where sources of radiation are, from the readings that have arrived."""

from __future__ import annotations

import argparse
from pathlib import Path

from rass_mav.commands.common import Subparsers, add_command, answer, clean, start_logging
from rass_mav.errors import RassError, os_errors_as

from .data import add_store, read_archive
from .export import refuse_existing
from .filters import add_filters, wanted


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    sources = add_command(
        subparsers, "sources", _sources, help="locate sources of radiation, with their strength and uncertainty",
        example="rass-mav sources base.yaml --geojson sources.geojson",
    )  # fmt: skip
    add_store(sources)
    sources.add_argument("--geojson", type=Path, metavar="FILE", help="also write places and regions to a file")
    add_filters(sources)


def _sources(options: argparse.Namespace) -> int:
    from rass_mav.ground.sources.locator import check_package, estimate_of
    from rass_mav.ground.sources.readings import Samples
    from rass_mav.ground.sources.texts import geojson, lines

    start_logging(options.verbose)
    filter = wanted(options)
    check_package()
    if options.geojson is not None:
        refuse_existing(options.geojson)
    samples = Samples()
    with read_archive(options) as archive:
        for entry in archive.entries(filter, parts=False):
            samples.take(entry)
    found = estimate_of(samples)
    if options.geojson is not None:
        with os_errors_as(RassError, options.geojson), options.geojson.open("x", encoding="ascii") as file:
            file.write(geojson(found))
    answer(options, found, map(clean, lines(found)))
    return 0
