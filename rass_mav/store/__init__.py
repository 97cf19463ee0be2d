"""Where a node keeps its data: in memory (`MemoryStore`) or on disk (`SqliteStore`).

Both implement `rass_mav.core.store.Store`. `SqliteReader` reads a store on disk from outside, also while the node that
owns it is running.
"""

from .memory import MemoryStore
from .reader import SqliteReader
from .report import OpenReport
from .sqlite import SqliteStore

__all__ = ["MemoryStore", "OpenReport", "SqliteReader", "SqliteStore"]
