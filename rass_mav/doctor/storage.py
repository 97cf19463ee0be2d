"""The store: can it be written, is there space, is it sound?"""

from __future__ import annotations

import os

from rass_mav.app.config import RunConfig
from rass_mav.app.endurance import endurance, left_in
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.store.disk import Space, space

from .finding import Finding, failed, passed, warned

_MIB = 1 << 20
#: A store that lasts for less without contact may not outlast a flight, seconds.
LEAST_S = 3600.0


def store(config: RunConfig, disk: Space | None = None) -> Finding:
    """Check the store's file and folder, and how long it lasts. `disk`: None: ask it."""
    path = config.store_path
    folder = path.absolute().parent
    effective = os.access in os.supports_effective_ids
    try:
        exists = folder.is_dir()
    except PermissionError:
        return failed("store", f"{folder}: no read permission", "run this as the node's user, or change store.path")
    if not exists:
        return failed("store", f"{folder}: no such folder", "create it, or change store.path")
    if not os.access(folder, os.W_OK | os.X_OK, effective_ids=effective):
        return failed(
            "store", f"{folder}: no write permission", "make the node's user its owner (chown), or change store.path"
        )
    if path.exists() and not os.access(path, os.R_OK | os.W_OK, effective_ids=effective):
        return failed("store", f"{path}: no write permission", "make the node's user its owner (chown)")
    try:
        left, held = left_in(config)
    except StoreDamagedError as error:
        return warned("store", str(error), "copy the file first: the node will set it aside and salvage what it can")
    except StoreError as error:
        return warned("store", str(error), "start the node and see its log")
    disk = space(folder) if disk is None else disk
    text = f"{path}: {f'{held} data' if path.exists() else 'not created yet'}, {disk.free / _MIB:.0f} MiB free"
    remedy = f"free space on the disk: the node leaves {disk.reserve / _MIB:.0f} MiB of it unused"
    if not disk.usable:
        return failed("store", text, remedy)
    if disk.usable < disk.reserve:
        return warned("store", text, remedy)
    if not config.is_base:
        lasts = endurance(config, left)
        text = f"{text}, {lasts.text}"
        if lasts.seconds < LEAST_S:
            return warned(
                "store", text, "bring the drone near a base, or raise store.capacity_items, store.quota_bytes or "
                "data.interval_steps",
            )  # fmt: skip
    aside = sorted(file for file in folder.glob(f"{path.name}.damaged-[0-9]*") if file.name[-1].isdigit())
    if aside:
        return warned(
            "store", f"{text}; {aside[-1].name} was set aside as damaged",
            "check the card or disk; delete the file once you no longer need its data",
        )  # fmt: skip
    return passed("store", text)
